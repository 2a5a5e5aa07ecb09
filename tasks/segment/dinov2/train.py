"""Train the linear head over a frozen DINOv2: its tokens once, then logistic regression on them.

The backbone sees every labelled window once; its tokens wait in a scratch file in float16, so that memory
does not grow with the land.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from typing import IO

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from flexroad.catalog.grid import Grid
from flexroad.tasks.errors import TaskError
from flexroad.tasks.io.orthophoto import read_photo
from flexroad.tasks.segment.dinov2.backbone import (
    EXAMPLE,
    MEAN,
    PATCH,
    STD,
    Backbone,
    Device,
    load_backbone,
    normalised,
)
from flexroad.tasks.segment.dinov2.head import About, Head
from flexroad.tasks.segment.dinov2.regression import Labels, Line, Settings, Windows, best_threshold, regress
from flexroad.tasks.segment.dinov2.windows import corners, cover
from flexroad.tasks.segment.training_types import Progress, Sample, Trained
from flexroad.tasks.types import Bools


class Options(Settings):
    """The backbone, what of it is used, and how the head learns."""

    backbone: str = Field(EXAMPLE, description="hub name, or folder with the backbone's weights")
    layers: int = Field(4, ge=1, le=40, description="tokens of the last so many layers are used")
    gsd_m: float = Field(0.2, ge=0.02, le=5, description="ground sampling distance of the windows (m)")
    window_px: int = Field(448, ge=28, le=2044, multiple_of=PATCH, description="side of a window (pixels)")
    device: Device = Field("auto", description="cpu, cuda, or auto: a GPU where there is one")
    half: bool = Field(False, description="half precision of the backbone")


def train(
    train: Sequence[Sample],
    validate: Sequence[Sample],
    options: Options,
    progress: Progress | None = None,
) -> Trained:
    """Learn to tell road from the rest; keep what did best on the validation tiles.

    Raises
    ------
    TaskError
        If the backbone is missing, or no tile has an orthophoto and labels of both kinds.
    """
    backbone = load_backbone(options.backbone, options.device, options.half)
    if options.layers > backbone.layers:
        raise TaskError(f"{backbone.name} has {backbone.layers} layers, not {options.layers}; lower layers")
    with tempfile.TemporaryFile() as first, tempfile.TemporaryFile() as second:
        learnt = _windows(train, backbone, options, first, "training")
        judged = _windows(validate, backbone, options, second, "validation")
        line, history = regress(learnt, judged, options, progress)
        threshold, iou = best_threshold(judged, line)
    facts: dict[str, str | int | float] = {
        "train_tiles": " ".join(learnt.tiles),
        "validation_tiles": " ".join(judged.tiles),
        "train_cells": learnt.cells,
        "train_road_cells": learnt.road,
        "validation_cells": judged.cells,
        "validation_road_cells": judged.road,
        "validation_loss": min(past.validation_loss for past in history),
        "validation_iou": iou,
        "epochs": len(history),
        "options": options.model_dump_json(),
    }
    return Trained(_head(line, threshold, facts, backbone, options).encode(), ".safetensors", history)


def _head(
    line: Line,
    threshold: float,
    facts: dict[str, str | int | float],
    backbone: Backbone,
    options: Options,
) -> Head:
    about = About(
        backbone=options.backbone,
        model_type=backbone.model_type,
        registers=backbone.registers,
        weights=backbone.weights,
        hidden_size=backbone.hidden_size,
        layers=options.layers,
        window_px=options.window_px,
        gsd_m=options.gsd_m,
        mean=MEAN,
        std=STD,
        classes=("road",),
        threshold=threshold,
        trained=facts,
    )
    return Head(line.weight[None], np.array([line.bias], np.float32), about)


def _windows(
    samples: Sequence[Sample], backbone: Backbone, options: Options, scratch: IO[bytes], name: str
) -> Windows:
    """Let the backbone see all labelled windows; its tokens go to the scratch file."""
    side = options.window_px // PATCH
    shape = (side, side, options.layers * backbone.hidden_size)
    labels: list[Labels] = []
    tiles: list[str] = []
    for sample in samples:
        tiles.append(sample.data.tile_id)
        for images, part in _batches(sample, options):
            tokens = backbone.tokens(images, options.layers).cpu().numpy()
            scratch.write(tokens.astype(np.float16).tobytes())
            labels += part
    road = sum(float(part.road.sum()) for part in labels)
    if not 0 < road < sum(len(part.road) for part in labels):
        raise TaskError(
            f"no {name} tile has an orthophoto and labels of road and of something else; "
            "give --dop to `flexroad catalog`, or train on more tiles"
        )
    scratch.flush()
    return Windows(np.memmap(scratch, np.float16, "r", shape=(len(labels), *shape)), labels, tiles)


def _batches(sample: Sample, options: Options) -> Iterator[tuple[NDArray[np.float32], list[Labels]]]:
    """Yield a tile's windows, some at a time, and the labels in each; none without labels."""
    data, size = sample.data, options.window_px
    if data.dop is None or not sample.known.any():
        return
    photo = read_photo(data.dop, cover(data.grid, options.gsd_m, size), options.gsd_m)
    image = normalised(photo)
    images, labels = [], []
    for row, col in corners(photo.known.shape, size):
        window = np.s_[row : row + size, col : col + size]
        west, north = photo.grid.west + col * options.gsd_m, photo.grid.north - row * options.gsd_m
        ground = Grid(photo.grid.crs, west, north, options.gsd_m, size, size)
        found = _labels(sample, ground, photo.known[window])
        if len(found.road):
            images.append(image[(slice(None), *window)])
            labels.append(found)
        if len(images) == options.batch:
            yield np.stack(images), labels
            images, labels = [], []
    if images:
        yield np.stack(images), labels


def _labels(sample: Sample, window: Grid, seen: Bools) -> Labels:
    """Return the labelled cells of a tile whose centres lie in a window where its photo is known."""
    grid = sample.data.grid
    rows = np.flatnonzero((grid.northings < window.north) & (grid.northings >= window.south))
    cols = np.flatnonzero((grid.eastings >= window.west) & (grid.eastings < window.east))
    north, east = (
        axis.ravel() for axis in np.meshgrid(grid.northings[rows], grid.eastings[cols], indexing="ij")
    )
    counts = sample.known[np.ix_(rows, cols)].ravel() & seen[window.cells(east, north)]
    x = 2 * (east - window.west) / (window.east - window.west) - 1
    y = 2 * (window.north - north) / (window.north - window.south) - 1
    road = sample.road[np.ix_(rows, cols)].ravel()[counts]
    return Labels(np.stack([x, y], axis=1)[counts].astype(np.float32), road.astype(np.float32))
