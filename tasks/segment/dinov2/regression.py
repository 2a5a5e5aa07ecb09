"""Logistic regression on the patch tokens of a frozen backbone, with the loss at the labelled cells.

An epoch passes once over the windows, in batches. Tokens are standardised by their mean and standard
deviation over the training windows: with frozen features this equals the batch norm of DINOv2's
segmentation head, and it folds into the linear map.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from flexroad.catalog.lazy import lazy
from flexroad.tasks.options import Options
from flexroad.tasks.segment.training_types import Epoch, Progress
from flexroad.tasks.types import Floats

if TYPE_CHECKING:
    import torch
else:
    torch = lazy("torch")

THRESHOLDS = np.linspace(0.01, 0.99, 99)
"""Candidates for the threshold."""


@dataclass(frozen=True, eq=False)
class Labels:
    """The labelled cells of one window."""

    position: NDArray[np.float32]
    """Column and row of the cells' centres, ``(m, 2)``, from -1 to 1 across the window."""
    road: NDArray[np.float32]
    """1 for road, else 0, ``(m,)``."""


@dataclass(frozen=True, eq=False)
class Windows:
    """Windows as tokens of the backbone, with their labels."""

    tokens: NDArray[np.float16]
    """``(n, h, w, features)``; may be a memory map."""
    labels: Sequence[Labels]
    tiles: Sequence[str]
    """Ids of the tiles they were cut from."""

    @property
    def road(self) -> int:
        """Number of labelled road cells."""
        return round(sum(float(part.road.sum()) for part in self.labels))

    @property
    def cells(self) -> int:
        """Number of labelled cells."""
        return sum(len(part.road) for part in self.labels)


@dataclass(frozen=True, eq=False)
class Line:
    """A linear map from a token to a logit."""

    weight: NDArray[np.float32]
    """``(features,)``."""
    bias: float


class Settings(Options):
    """Options of the training."""

    epochs: int = Field(100, ge=1, description="maximum number of epochs")
    patience: int = Field(8, ge=1, description="stop after this many epochs without a better validation loss")
    learning_rate: float = Field(0.003, gt=0, description="learning rate of AdamW, on standardised tokens")
    weight_decay: float = Field(0.01, ge=0, description="weight decay of AdamW")
    balance: float = Field(
        0.5, ge=0, le=1, description="weight of road cells: (other cells per road cell) to this power"
    )
    batch: int = Field(4, ge=1, le=1024, description="windows per batch")
    seed: int = Field(0, ge=0, description="seed of the order of the windows")


class Regression:
    """A linear map trained by AdamW on the weighted cross entropy."""

    def __init__(self, windows: Windows, settings: Settings) -> None:
        self.centre, self.spread = (torch.tensor(m, dtype=torch.float32) for m in _moments(windows.tokens))
        self.road_weight = ((windows.cells - windows.road) / windows.road) ** settings.balance
        self.weight = torch.zeros(len(self.centre), requires_grad=True)
        self.bias = torch.zeros((), requires_grad=True)
        self.adam: Any = torch.optim.AdamW(
            [self.weight, self.bias], lr=settings.learning_rate, weight_decay=settings.weight_decay
        )

    def folded(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Return weight and bias for tokens that are not standardised."""
        weight = self.weight / self.spread
        return weight, self.bias - weight @ self.centre

    def line(self) -> Line:
        """Return the current linear map."""
        weight, bias = self.folded()
        return Line(weight.detach().numpy().copy(), bias.item())

    def loss(self, windows: Windows, which: NDArray[np.intp]) -> tuple[torch.Tensor, float]:
        """Return the summed cross entropy of the labelled cells in windows ``which``, and their weight."""
        logits, road = at_cells(windows, which, *self.folded())
        weights = 1 + (self.road_weight - 1) * road
        entropy = torch.nn.functional.binary_cross_entropy_with_logits
        return entropy(logits, road, weights, reduction="sum"), float(weights.sum())

    def train_epoch(self, windows: Windows, order: NDArray[np.intp], batch: int) -> float:
        """Train one epoch; return the mean loss during it."""
        sums = np.zeros(2)
        for which in _batches(order, batch):
            self.adam.zero_grad()
            loss, weight = self.loss(windows, which)
            (loss / weight).backward()
            self.adam.step()
            sums += loss.item(), weight
        return float(sums[0] / sums[1])

    def mean_loss(self, windows: Windows, batch: int) -> float:
        """Return the mean loss over windows, without training."""
        sums = np.zeros(2)
        with torch.no_grad():
            for which in _batches(np.arange(len(windows.labels)), batch):
                loss, weight = self.loss(windows, which)
                sums += loss.item(), weight
        return float(sums[0] / sums[1])


def regress(
    train: Windows, validate: Windows, settings: Settings, progress: Progress | None = None
) -> tuple[Line, tuple[Epoch, ...]]:
    """Train; return the map with the lowest loss on ``validate``, and the losses of all epochs."""
    regression = Regression(train, settings)
    rng = np.random.default_rng(settings.seed)
    history: list[Epoch] = []
    best = regression.line()
    lowest, since = np.inf, 0
    while len(history) < settings.epochs and since < settings.patience:
        loss = regression.train_epoch(train, rng.permutation(len(train.labels)), settings.batch)
        history.append(Epoch(loss, regression.mean_loss(validate, settings.batch)))
        since += 1
        if history[-1].validation_loss < lowest:
            best, lowest, since = regression.line(), history[-1].validation_loss, 0
        if progress:
            progress(len(history), settings.epochs, history[-1])
    return best, tuple(history)


def at_cells(
    windows: Windows, which: NDArray[np.intp], weight: torch.Tensor, bias: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the logits at the labelled cells of windows ``which``, ``(m,)``, and their labels, 1 for road.

    The logits of the patches are interpolated as in `head.predictor`: bilinear, corners not aligned.
    """
    logits = []
    for i in which:
        coarse = torch.from_numpy(windows.tokens[i].astype(np.float32)) @ weight + bias
        position = torch.from_numpy(windows.labels[i].position)
        fine = torch.nn.functional.grid_sample(
            coarse[None, None], position[None, None], padding_mode="border", align_corners=False
        )
        logits.append(fine.ravel())
    road = np.concatenate([windows.labels[i].road for i in which])
    return torch.cat(logits), torch.from_numpy(road)


def best_threshold(windows: Windows, line: Line) -> tuple[float, float]:
    """Return the probability threshold with the best IoU, and that IoU."""
    weight, bias = torch.from_numpy(line.weight), torch.tensor(line.bias)
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
    # A constant feature must not cause a division by 0.
    return centre, np.sqrt(np.maximum(square / n - centre**2, 1e-12))


def _batches(order: NDArray[np.intp], size: int) -> Iterator[NDArray[np.intp]]:
    for start in range(0, len(order), size):
        yield order[start : start + size]
