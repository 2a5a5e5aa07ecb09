"""Step B of the paper, road extraction: M^r by gradient-boosted trees on cells and their neighbourhood."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import Field

from flexroad.tasks import options
from flexroad.tasks.errors import LayerMissing
from flexroad.tasks.roads import coregistration
from flexroad.tasks.roads.extent import beyond_extent
from flexroad.tasks.roads.mask_cleanup import Cleanup, clean
from flexroad.tasks.segment.pixels.features import REACH_M, features, read_tile_photo
from flexroad.tasks.segment.pixels.model import About, read_model
from flexroad.tasks.types import Orthophoto, RoadMask, TileData

VERSION = 1
READS = ("dop", "roads")
"""``roads`` is read only if the cleanup uses it."""
CONTEXT_M = REACH_M
"""A cell's class depends on the ground up to this distance (m)."""
FULL_COVERAGE = 0.99
"""Fraction of the tile covered by the photo, below which a note gives the fraction."""


class Options(options.Options):
    """Model, threshold and cleanup."""

    method: Literal["pixels"] = "pixels"
    model: Path = Field(description="file of the model, made by `flexroad train CATALOG --method pixels`")
    threshold: float | None = Field(
        None, gt=0, lt=1, description="probability from which a cell is road; null: the model's"
    )
    cleanup: Cleanup = Field(Cleanup(), description="cleanup of the mask")


def files(options: Options) -> tuple[Path, ...]:
    """Return the files that the result depends on besides the tile: the model."""
    return (options.model,)


def segment(data: TileData, options: Options) -> RoadMask:
    """Return the road mask predicted by the model.

    Raises
    ------
    TaskError
        If the model is missing or damaged, or it needs an orthophoto and the tile has none.
    """
    model = read_model(options.model)
    photo = _photo(data, model.about, options.model)
    beyond = beyond_extent(data)
    probability = model.probability(features(data, photo), ~beyond)
    threshold = options.threshold or model.about.threshold
    mask = clean(probability >= threshold, data, options.cleanup)
    notes = _notes(data, photo, model.about)
    if data.lacks_road(mask):
        highest = probability[data.grid.window(data.core)].max()
        notes += (
            f"segment: no road on this tile: probabilities reach {highest:.2f}, the threshold is "
            f"{threshold:g}; if there are roads, lower segment.threshold, or train on similar tiles",
        )
    return RoadMask(data.grid, data.core, mask, beyond, probability=probability, notes=notes)


def _photo(data: TileData, about: About, path: Path) -> Orthophoto | None:
    """Return the tile's photo, or None if the model does not use one."""
    if not about.photo:
        return None
    photo = read_tile_photo(data)
    if photo is None:
        raise LayerMissing(
            f"the tile has no orthophoto (layer dop), and {path.name} was trained with colours: give --dop "
            "to `flexroad catalog rasters`, or train a model on heights alone (--set photo=false)",
            layer="dop",
        )
    return photo


def _notes(data: TileData, photo: Orthophoto | None, about: About) -> tuple[str, ...]:
    notes: list[str | None] = []
    if abs(data.grid.cell / about.cell_m - 1) > 0.01:
        notes.append(
            f"segment: the model was trained on cells of {about.cell_m:g} m, not {data.grid.cell:g} m"
        )
    if photo is not None:
        covered = photo.known.mean()
        notes.append(
            f"dop: covers {covered:.0%} of the tile and its halo" if covered < FULL_COVERAGE else None
        )
        notes.append(coregistration.note(data, photo))
    return tuple(filter(None, notes))
