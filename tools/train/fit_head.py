"""Train the linear head on a frozen DINOv2: logistic regression on its patch tokens.

The tokens of every labelled window are computed once and kept in a temporary file (float16), so memory does
not grow with the number of tiles.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import IO, TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from flexroad.catalog.grid import Grid
from flexroad.catalog.lazy import lazy
from flexroad.catalog.text import Notify
from flexroad.tasks import options as base
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
from flexroad.tasks.segment.dinov2.windows import corners, cover
from flexroad.tasks.types import Bools, Floats, TileData

if TYPE_CHECKING:
    import torch
else:
    torch = lazy("torch")

THRESHOLDS = np.linspace(0.01, 0.99, 99)
"""Candidates for the threshold."""


@dataclass(frozen=True, eq=False)
class Sample:
    """One labelled tile for training or validation."""

    data: TileData
    """The tile with its halo."""
    road: Bools
    """Road according to the labels, ``(H, W)``."""
    labelled: Bools
    """Cells whose label is used, ``(H, W)``: inside survey and tile, outside the band along label edges."""


Losses = tuple[float, float]
"""Mean loss of training and validation in one epoch."""
Labels = tuple[NDArray[np.float32], NDArray[np.float32]]
"""Labelled cells of one window: column and row of their centres, ``(m, 2)``, from -1 to 1 across the window;
and 1 for road, else 0, ``(m,)``."""


@dataclass(frozen=True, eq=False)
class Windows:
    """Windows as tokens of the backbone, with their labels."""

    tokens: NDArray[np.float16]
    """``(n, h, w, features)``; may be a memory map."""
    labels: Sequence[Labels]
    tiles: Sequence[str]
    """Ids of the tiles from which the windows were cut."""

    @property
    def road(self) -> int:
        """Number of labelled road cells."""
        return round(sum(float(road.sum()) for _, road in self.labels))

    @property
    def cells(self) -> int:
        """Number of labelled cells."""
        return sum(len(road) for _, road in self.labels)


class Options(base.Options):
    """The training of the head, the backbone, its layers, and the windows."""

    epochs: int = Field(100, ge=1, description="maximum number of epochs")
    patience: int = Field(8, ge=1, description="stop after this many epochs without a better validation loss")
    learning_rate: float = Field(0.003, gt=0, description="learning rate of AdamW, on standardised tokens")
    weight_decay: float = Field(0.01, ge=0, description="weight decay of AdamW")
    balance: float = Field(
        0.5, ge=0, le=1, description="weight of road cells: (other cells per road cell) to this power"
    )
    batch: int = Field(4, ge=1, le=1024, description="windows per batch")
    seed: int = Field(0, ge=0, description="seed of the order of the windows")
    backbone: str = Field(EXAMPLE, description="hub name, or folder with the backbone's weights")
    layers: int = Field(4, ge=1, le=40, description="number of last layers whose tokens are used")
    gsd_m: float = Field(0.2, ge=0.02, le=5, description="ground sampling distance of the windows (m)")
    window_px: int = Field(448, ge=28, le=2044, multiple_of=PATCH, description="side of a window (pixels)")
    device: Device = Field("auto", description="cpu, cuda, or auto: a GPU if there is one")
    half: bool = Field(False, description="run the backbone in half precision")


def train(
    train: Iterable[Sample], validate: Iterable[Sample], options: Options, notify: Notify
) -> tuple[bytes, tuple[Losses, ...]]:
    """Train a head; return the model file of the epoch with the lowest validation loss, and all losses."""
    backbone = load_backbone(options.backbone, options.device, options.half)
    if options.layers > backbone.layers:
        raise TaskError(f"{backbone.name} has {backbone.layers} layers, not {options.layers}; lower layers")
    with tempfile.TemporaryFile() as first, tempfile.TemporaryFile() as second:
        train_windows = _windows(train, backbone, options, first, "training")
        validation = _windows(validate, backbone, options, second, "validation")
        weight, bias, history = regress(train_windows, validation, options, notify)
        threshold, iou = best_threshold(validation, weight, bias)
    facts: dict[str, str | int | float] = {
        "train_tiles": " ".join(train_windows.tiles),
        "validation_tiles": " ".join(validation.tiles),
        "train_cells": train_windows.cells,
        "train_road_cells": train_windows.road,
        "validation_cells": validation.cells,
        "validation_road_cells": validation.road,
        "validation_loss": min(loss for _, loss in history),
        "validation_iou": iou,
        "epochs": len(history),
        "options": options.model_dump_json(),
    }
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
    return Head(weight[None].numpy(), bias[None].numpy(), about).encode(), history


def _windows(
    samples: Iterable[Sample], backbone: Backbone, options: Options, scratch: IO[bytes], name: str
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
    scratch.flush()
    if not 0 < sum(float(road.sum()) for _, road in labels) < sum(len(road) for _, road in labels):
        raise TaskError(
            f"no {name} tile has an orthophoto and labels of both road and other ground; "
            "give --dop to `flexroad catalog`, or train on more tiles"
        )
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
        window_labels = _labels(sample, photo.grid.part(*window), photo.known[window])
        if len(window_labels[1]):
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
    return np.stack([x, y], axis=1)[used].astype(np.float32), road.astype(np.float32)


class _Regression:
    """A linear map trained by AdamW on the weighted cross entropy."""

    def __init__(self, windows: Windows, options: Options) -> None:
        self.batch = options.batch
        self.centre, self.spread = (torch.tensor(m, dtype=torch.float32) for m in _moments(windows.tokens))
        self.road_weight = ((windows.cells - windows.road) / windows.road) ** options.balance
        self.weight = torch.zeros(len(self.centre), requires_grad=True)
        self.bias = torch.zeros((), requires_grad=True)
        self.adam: Any = torch.optim.AdamW(
            [self.weight, self.bias], lr=options.learning_rate, weight_decay=options.weight_decay
        )

    def line(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Return weight and bias for tokens before standardisation."""
        weight = self.weight / self.spread
        return weight, self.bias - weight @ self.centre

    def mean_loss(self, windows: Windows, order: NDArray[np.intp], learn: bool) -> float:
        """Return the mean cross entropy of the labelled cells over windows; optionally learn each batch."""
        entropy = torch.nn.functional.binary_cross_entropy_with_logits
        sums = np.zeros(2)
        with torch.set_grad_enabled(learn):
            for start in range(0, len(order), self.batch):
                logits, road = at_cells(windows, order[start : start + self.batch], *self.line())
                weights = 1 + (self.road_weight - 1) * road
                loss, weight = entropy(logits, road, weights, reduction="sum"), float(weights.sum())
                if learn:
                    self.adam.zero_grad()
                    (loss / weight).backward()
                    self.adam.step()
                sums += loss.item(), weight
        return float(sums[0] / sums[1])


def regress(
    train: Windows, validate: Windows, options: Options, notify: Notify
) -> tuple[torch.Tensor, torch.Tensor, tuple[Losses, ...]]:
    """Train; return weight and bias with the lowest loss on ``validate``, and the losses of all epochs."""
    regression = _Regression(train, options)
    rng = np.random.default_rng(options.seed)
    history: list[Losses] = []
    best = regression.line()
    lowest, since = np.inf, 0
    while len(history) < options.epochs and since < options.patience:
        loss = regression.mean_loss(train, rng.permutation(len(train.labels)), learn=True)
        validation = regression.mean_loss(validate, np.arange(len(validate.labels)), learn=False)
        history.append((loss, validation))
        since += 1
        if validation < lowest:
            best, lowest, since = regression.line(), validation, 0
        notify(f"epoch {len(history)} of {options.epochs}: loss {loss:.4f}, validation {validation:.4f}")
    weight, bias = (part.detach() for part in best)
    return weight, bias, tuple(history)


def at_cells(
    windows: Windows, which: NDArray[np.intp], weight: torch.Tensor, bias: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the logits at the labelled cells of windows ``which``, ``(m,)``, and their labels, 1 for road.

    The logits of the patches are interpolated as in `head.predictor`: bilinear, corners not aligned.
    """
    logits = []
    for i in which:
        coarse = torch.from_numpy(windows.tokens[i].astype(np.float32)) @ weight + bias
        position = torch.from_numpy(windows.labels[i][0])
        fine = torch.nn.functional.grid_sample(
            coarse[None, None], position[None, None], padding_mode="border", align_corners=False
        )
        logits.append(fine.ravel())
    road = np.concatenate([windows.labels[i][1] for i in which])
    return torch.cat(logits), torch.from_numpy(road)


def best_threshold(windows: Windows, weight: torch.Tensor, bias: torch.Tensor) -> tuple[float, float]:
    """Return the probability threshold with the best IoU, and that IoU."""
    counts = np.zeros((2, len(THRESHOLDS) + 1))
    for i in range(len(windows.labels)):
        logits, road = at_cells(windows, np.array([i]), weight, bias)
        level = np.searchsorted(THRESHOLDS, logits.sigmoid().numpy(), side="right")
        for label in (0, 1):
            counts[label] += np.bincount(level[road.numpy() == label], minlength=counts.shape[1])
    # Number of cells of each class at or above each threshold.
    wrong, right = counts[:, ::-1].cumsum(axis=1)[:, ::-1][:, 1:]
    iou = right / (counts[1].sum() + wrong)
    best = int(iou.argmax())
    return float(THRESHOLDS[best]), float(iou[best])


def _moments(tokens: NDArray[np.float16]) -> tuple[Floats, Floats]:
    """Return mean and standard deviation of each feature, ``(features,)``; reads one window at a time."""
    total, square = np.zeros(tokens.shape[-1]), np.zeros(tokens.shape[-1])
    for window in tokens:
        values = window.reshape(-1, tokens.shape[-1]).astype(np.float64)
        total += values.sum(axis=0)
        square += (values**2).sum(axis=0)
    n = tokens[..., 0].size
    centre = total / n
    # Avoids a division by 0 for a constant feature.
    return centre, np.sqrt(np.maximum(square / n - centre**2, 1e-12))
