"""Train the linear head on a frozen DINOv2: logistic regression on its patch tokens.

The tokens of every labelled window are computed once and kept in a temporary file (float16), so memory does
not grow with the number of tiles.
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
    """The backbone, its layers, the windows, and the training of the head."""

    backbone: str = Field(EXAMPLE, description="hub name, or folder with the backbone's weights")
    layers: int = Field(4, ge=1, le=40, description="number of last layers whose tokens are used")
    gsd_m: float = Field(0.2, ge=0.02, le=5, description="ground sampling distance of the windows (m)")
    window_px: int = Field(448, ge=28, le=2044, multiple_of=PATCH, description="side of a window (pixels)")
    device: Device = Field("auto", description="cpu, cuda, or auto: a GPU if there is one")
    half: bool = Field(False, description="run the backbone in half precision")


def train(
    train: Sequence[Sample],
    validate: Sequence[Sample],
    options: Options,
    progress: Progress | None = None,
) -> Trained:
    """Train a head; keep the epoch with the lowest loss on the validation tiles.

    Raises
    ------
    TaskError
        If the backbone is missing, or no training or no validation tile has an orthophoto and labels of both
        road and other ground.
    """
    backbone = load_backbone(options.backbone, options.device, options.half)
    if options.layers > backbone.layers:
        raise TaskError(f"{backbone.name} has {backbone.layers} layers, not {options.layers}; lower layers")
    with tempfile.TemporaryFile() as first, tempfile.TemporaryFile() as second:
        train_windows = _windows(train, backbone, options, first, "training")
        validation = _windows(validate, backbone, options, second, "validation")
        line, history = regress(train_windows, validation, options, progress)
        threshold, iou = best_threshold(validation, line)
    facts: dict[str, str | int | float] = {
        "train_tiles": " ".join(train_windows.tiles),
        "validation_tiles": " ".join(validation.tiles),
        "train_cells": train_windows.cells,
        "train_road_cells": train_windows.road,
        "validation_cells": validation.cells,
        "validation_road_cells": validation.road,
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
    """Compute the tokens of all labelled windows and write them to the scratch file."""
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
            f"no {name} tile has an orthophoto and labels of both road and other ground; "
            "give --dop to `flexroad catalog`, or train on more tiles"
        )
    scratch.flush()
    return Windows(np.memmap(scratch, np.float16, "r", shape=(len(labels), *shape)), labels, tiles)


def _batches(sample: Sample, options: Options) -> Iterator[tuple[NDArray[np.float32], list[Labels]]]:
    """Yield a tile's windows in batches, each with its labels; windows without labels are left out."""
    data, size = sample.data, options.window_px
    if data.dop is None or not sample.labelled.any():
        return
    photo = read_photo(data.dop, cover(data.grid, options.gsd_m, size), options.gsd_m)
    image = normalised(photo)
    images, labels = [], []
    for row, col in corners(photo.known.shape, size):
        window = np.s_[row : row + size, col : col + size]
        west, north = photo.grid.west + col * options.gsd_m, photo.grid.north - row * options.gsd_m
        ground = Grid(photo.grid.crs, west, north, options.gsd_m, size, size)
        window_labels = _labels(sample, ground, photo.known[window])
        if len(window_labels.road):
            images.append(image[(slice(None), *window)])
            labels.append(window_labels)
        if len(images) == options.batch:
            yield np.stack(images), labels
            images, labels = [], []
    if images:
        yield np.stack(images), labels


def _labels(sample: Sample, window: Grid, covered: Bools) -> Labels:
    """Return the tile's labelled cells whose centres lie on pixels of a window that the photo covers."""
    grid = sample.data.grid
    rows = np.flatnonzero((grid.northings < window.north) & (grid.northings >= window.south))
    cols = np.flatnonzero((grid.eastings >= window.west) & (grid.eastings < window.east))
    north, east = (
        axis.ravel() for axis in np.meshgrid(grid.northings[rows], grid.eastings[cols], indexing="ij")
    )
    used = sample.labelled[np.ix_(rows, cols)].ravel() & covered[window.cells(east, north)]
    x = 2 * (east - window.west) / (window.east - window.west) - 1
    y = 2 * (window.north - north) / (window.north - window.south) - 1
    road = sample.road[np.ix_(rows, cols)].ravel()[used]
    return Labels(np.stack([x, y], axis=1)[used].astype(np.float32), road.astype(np.float32))
