"""Train the head of `segment: dinov2` on some tiles of a catalog and validate it on other, separate tiles.

Neighbouring tiles show the same streets, so a random split overestimates the quality of a model. Instead one
straight line divides the tiles, and cells near the validation side are not used for training.

Validation runs the segmenter like a run, with the trained model but without cleanup. So the metrics are
metrics of the model alone.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import MISSING, dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from flexroad.catalog import Bounds, Catalog, Grid, Tile
from flexroad.catalog.storage.scratch import ScratchFolder
from flexroad.catalog.text import Notify, count, printable, shown
from flexroad.pipeline.config.models import Config
from flexroad.pipeline.config.options import INPUTS, METHOD, VALIDATION, option
from flexroad.pipeline.errors import ConfigError
from flexroad.tasks import load
from flexroad.tasks.errors import TaskError
from flexroad.tasks.io.orthophoto import read_photo
from flexroad.tasks.roads import rasterise
from flexroad.tasks.roads.distances import within
from flexroad.tasks.segment.dinov2 import segment as segmenter
from flexroad.tasks.types import Bools, RoadMask, TileData
from flexroad.tools.train import fit_head
from flexroad.tools.train.fit_head import Losses, Sample
from flexroad.tools.train.mask_metrics import Quality, judge, together

Labels = Literal["mask", "vector"]
DIRECTIONS = 8
"""Number of directions of the line between training and validation that are tried."""


@dataclass(frozen=True)
class TrainOptions:
    """Options of ``flexroad train``."""

    labels: Labels = option(
        MISSING, INPUTS, "mask: the catalog's reference road or road mask; vector: its vector roads."
    )
    validation: float = 0.3
    """Share of the tiles for validation."""
    gap_m: float = option(
        50.0,
        VALIDATION,
        "Distance of training cells from validation tiles (m).",
        "METRES",
        min=0,
        name="gap-m",
    )
    ignore_m: float = 1.0
    """Distance of training cells from edges of labels (m), which are never exact."""
    seed: int = option(0, METHOD, "Seed of the split and of the training.", "N", min=0)
    settings: Mapping[str, Any] | None = None
    """Options of the head's training, by name; None for the defaults."""


@dataclass(frozen=True)
class Block:
    """A tile, or a part of it, on one side of the line."""

    tile: Tile
    bounds: Bounds
    """Area whose labels are used."""
    road: int
    """Number of labelled road cells."""
    ground: int
    """Number of labelled cells of other ground."""


@dataclass(frozen=True)
class Split:
    """Blocks of the training side and of the validation side."""

    train: tuple[Block, ...]
    validate: tuple[Block, ...]
    gap_m: float
    """Training cells are at least this far from the validation side (m)."""

    def training_cells(self, grid: Grid, bounds: Bounds) -> Bools:
        """Return the cells within the bounds and far enough from the validation side, ``(H, W)``."""
        cells = inside(grid, bounds)
        for piece in self.validate:
            west, south, east, north = piece.bounds
            excluded = (west - self.gap_m, south - self.gap_m, east + self.gap_m, north + self.gap_m)
            cells &= ~inside(grid, excluded)
        return cells


def inside(grid: Grid, bounds: Bounds) -> Bools:
    """Return the cells of a grid whose centres lie within bounds, ``(H, W)``."""
    west, south, east, north = bounds
    rows = (grid.northings > south) & (grid.northings < north)
    cols = (grid.eastings > west) & (grid.eastings < east)
    return np.asarray(rows[:, None] & cols)


@dataclass(frozen=True, eq=False)
class Evaluation:
    """Quality of the model on one block of the validation side."""

    piece: Block
    quality: Quality
    inner: Quality
    """Quality without the band along the labels' edges."""
    mask: NDArray[np.uint8]
    """Predicted mask of the tile's core, packed with 8 cells per byte."""
    note: str = ""
    """Error of the segmentation; empty if it succeeded."""


@dataclass(frozen=True)
class LabelledTiles:
    """Reads tiles with their labels. Nothing is cached, so memory does not grow with the number of tiles."""

    options: TrainOptions
    load: load.Options
    vectors: rasterise.Options

    def labelled(self, tile: Tile) -> tuple[TileData, Bools] | None:
        """Return a tile and its labels, ``(H, W)``; None without labels."""
        data = load.load(tile, self.load)
        if self.options.labels == "vector":
            return None if data.roads is None else (data, rasterise.rasterise_roads(data, self.vectors))
        road = data.road_mask if data.reference_road is None else data.reference_road
        return None if road is None else (data, road)

    def read(self, tile: Tile) -> tuple[TileData, Bools]:
        """Return a tile that is expected to have labels, and its labels."""
        labelled = self.labelled(tile)
        if labelled is None:
            raise TaskError(f"tile {tile.id} has lost its labels since training began; start again")
        return labelled

    def usable_cells(self, data: TileData, road: Bools) -> Bools:
        """Return the cells within the survey and outside the band along label edges, ``(H, W)``."""
        cell, width = data.grid.cell, self.options.ignore_m
        band = within(road, cell, width) & within(~road, cell, width)
        return ~data.beyond_extent() & ~band

    def blocks(self, tile: Tile, parts: Sequence[Bounds]) -> list[Block]:
        """Return a block for each part of a tile that has labelled cells."""
        labelled = self.labelled(tile)
        if labelled is None:
            return []
        data, road = labelled
        usable = self.usable_cells(data, road)
        per_part = [usable & inside(data.grid, bounds) for bounds in parts]
        return [
            Block(tile, bounds, int((cells & road).sum()), int((cells & ~road).sum()))
            for bounds, cells in zip(parts, per_part, strict=True)
            if cells.any()
        ]


@dataclass(frozen=True, eq=False)
class Outcome:
    """A trained model and its validation."""

    tiles: LabelledTiles
    model: bytes
    """Content of the model file."""
    history: tuple[Losses, ...]
    """One entry per epoch, in order."""
    split: Split
    judged: tuple[Evaluation, ...]
    notes: tuple[str, ...]

    def preview(self, evaluation: Evaluation) -> tuple[NDArray[np.uint8], Bools, Bools, Grid]:
        """Read a tile again; return photo, road by the labels and by the model, and grid."""
        data, truth = self.tiles.read(evaluation.piece.tile)
        window = data.grid.window(data.core)
        mask = np.unpackbits(evaluation.mask, count=data.core.width * data.core.height).astype(bool)
        # Tiles without a photo have been left out before.
        assert data.dop is not None
        photo = read_photo(data.dop, data.core).colour
        return photo, truth[window], mask.reshape(data.core.shape), data.core

    @property
    def quality(self) -> Quality:
        """Quality over all blocks of the validation side."""
        return together(one.quality for one in self.judged)

    @property
    def inner(self) -> Quality:
        """Quality without the band along the labels' edges."""
        return together(one.inner for one in self.judged)


def samples(
    tiles: LabelledTiles, blocks: Sequence[Block], select: Callable[[Grid, Bounds], Bools]
) -> Iterator[Sample]:
    """Yield the sample of each block; ``select`` returns the cells of a grid that are used within bounds."""
    for block in blocks:
        data, road = tiles.read(block.tile)
        yield Sample(data, road, tiles.usable_cells(data, road) & select(data.grid, block.bounds))


def train(catalog: Catalog, config: Config, options: TrainOptions, notify: Notify) -> Outcome:
    """Train a head on a catalog and validate it.

    - `config`: the options of `load` of its first exported variant are used, and of `segment` if it is
      dinov2.
    - `notify`: called with each line of progress.
    """
    settings = _settings(options)
    chain = config.chains[config.export.variants[0]]
    configured = chain["segment"]
    vectors = configured if isinstance(configured, rasterise.Options) else rasterise.DEFAULTS
    tiles = LabelledTiles(options, chain["load"], vectors)
    notes: list[str] = []
    sides = _split(list(_labelled(catalog, tiles, notes)), options)
    notify(f"{count(len(sides.train), 'tile')} for training, {len(sides.validate)} for validation")
    trained, history = fit_head.train(
        samples(tiles, sides.train, sides.training_cells),
        samples(tiles, sides.validate, inside),
        settings,
        notify,
    )
    with ScratchFolder() as folder:
        model = Path(folder, "model.safetensors")
        model.write_bytes(trained)
        given = configured.model_dump() if isinstance(configured, segmenter.Options) else {}
        # Without cleanup, so that the figures describe the model alone.
        applied = segmenter.Options(**given | {"model": model, "cleanup": "none"})
        judged = tuple(
            _evaluate(block, tiles, lambda data: segmenter.segment(data, applied)) for block in sides.validate
        )
    notes += [f"{each.piece.tile.id}: {each.note}" for each in judged if each.note]
    return Outcome(tiles, trained, history, sides, judged, tuple(notes))


def _evaluate(block: Block, tiles: LabelledTiles, segment: Callable[[TileData], RoadMask]) -> Evaluation:
    data, road = tiles.read(block.tile)
    surveyed = inside(data.grid, block.bounds) & ~data.beyond_extent()
    note = ""
    try:
        mask = segment(data)
        cells, probability = mask.mask, mask.probability
    except TaskError as error:
        # A tile whose segmentation fails is treated as a tile without predicted road.
        cells, probability, note = np.zeros_like(road), np.zeros(road.shape, np.float32), str(error)
    whole, inner = (
        judge(cells, probability, road, scored, data.grid)
        for scored in (surveyed, surveyed & tiles.usable_cells(data, road))
    )
    core = cells[data.grid.window(data.core)]
    return Evaluation(block, whole, inner, np.packbits(core), note)


def _labelled(catalog: Catalog, tiles: LabelledTiles, notes: list[str]) -> Iterator[Block]:
    """Yield the tiles with labels, a single tile in two parts; add a note for each unreadable tile."""
    single = len(catalog.usable) == 1
    for tile in catalog.tiles:
        if tile.layer("dop") is None:
            continue
        bounds = tile.grid.bounds
        try:
            yield from tiles.blocks(
                tile, split_tile(bounds, tiles.options.validation) if single else [bounds]
            )
        except TaskError as error:
            notes.append(f"{tile.id} is left out: {error}")


def _split(pieces: Sequence[Block], options: TrainOptions) -> Split:
    _check_labels(pieces, options)
    if len(pieces) == 1:
        raise ConfigError(
            f"only tile {pieces[0].tile.id} has labels, none is left for validation: label another tile, or "
            "make a catalog of this tile alone, which is then split in two"
        )
    sides = split(pieces, options.validation, options.gap_m, options.seed)
    train = tuple(piece for piece in sides.train if sides.training_cells(piece.tile.grid, piece.bounds).any())
    if not any(piece.road for piece in train):
        raise ConfigError(
            f"no road for training lies {options.gap_m:g} m or more from the validation tiles; "
            "lower --gap-m, or label more tiles"
        )
    return Split(train, sides.validate, sides.gap_m)


def _check_labels(pieces: Sequence[Block], options: TrainOptions) -> None:
    if not pieces:
        missing = {
            "vector": "vectors of roads: give --roads to `flexroad catalog rasters`",
            "mask": "a mask of roads: give --reference-road or --road-mask to `flexroad catalog rasters`",
        }[options.labels]
        raise ConfigError(f"no readable tile has {missing} and an orthophoto (--dop)")
    road, ground = (sum(counts) for counts in zip(*((p.road, p.ground) for p in pieces), strict=True))
    if not road or not ground:
        raise ConfigError(
            f"the labels of all {len(pieces)} tiles are {'road' if road else 'no road'}: training needs "
            "both; check --road-value of `flexroad catalog rasters`, or the vectors' segment.where"
        )


def _settings(options: TrainOptions) -> fit_head.Options:
    try:
        return fit_head.Options(**{"seed": options.seed, **(options.settings or {})})
    except ValidationError as error:
        fault = error.errors()[0]
        name = printable(".".join(str(part) for part in fault["loc"]))
        raise ConfigError(
            f"--set {name}: {fault['msg'].lower()}, not {shown(fault['input'])}; "
            f"the training has {', '.join(fit_head.Options.model_fields)}"
        ) from error


def split(pieces: Sequence[Block], share: float, gap_m: float, seed: int) -> Split:
    """Split blocks by a straight line into a training side and a validation side.

    Eight directions of the line are tried in an order drawn from the seed. The first direction with road and
    other ground on both sides is used.

    - `pieces`: at least two blocks, all in one CRS.
    - `share`: fraction of the blocks on the validation side, 0 to 1; each side has at least one block.
    """
    count = min(max(1, round(share * len(pieces))), len(pieces) - 1)
    for turn in np.random.default_rng(seed).permutation(DIRECTIONS):
        angle = 2 * math.pi * turn / DIRECTIONS
        along = [
            math.sin(angle) * (w + e) + math.cos(angle) * (s + n)
            for w, s, e, n in (one.bounds for one in pieces)
        ]
        order = np.argsort(along, kind="stable")
        validate = tuple(pieces[i] for i in sorted(order[-count:]))
        train = tuple(pieces[i] for i in sorted(order[:-count]))
        if _has_both(train) and _has_both(validate):
            return Split(train, validate, gap_m)
    raise ConfigError(
        "no straight line splits the tiles into two sides with road and other ground on each: "
        f"{len(pieces)} tiles with labels, "
        f"{sum(piece.road > 0 for piece in pieces)} of them with road; label more tiles"
    )


def split_tile(bounds: Bounds, share: float) -> tuple[Bounds, Bounds]:
    """Return the bounds of two parts of a tile, for a catalog with a single tile.

    The second part has a fraction ``share`` of the area. It is in the east, or in the south of a tall tile.
    """
    west, south, east, north = bounds
    if east - west >= north - south:
        middle = east - share * (east - west)
        return (west, south, middle, north), (middle, south, east, north)
    middle = south + share * (north - south)
    return (west, middle, east, north), (west, south, east, middle)


def _has_both(pieces: Sequence[Block]) -> bool:
    return any(piece.road for piece in pieces) and any(piece.ground for piece in pieces)
