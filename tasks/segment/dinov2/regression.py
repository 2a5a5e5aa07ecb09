"""Logistic regression on the patch tokens of a frozen backbone, judged where the labels are: at the cells.

An epoch goes once over the windows, some at a time. Tokens are standardised by mean and deviation over the
training windows, which is what the batch norm of DINOv2's segmentation head comes to when features are
frozen; it folds into the linear map.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from flexroad.tasks.options import Options
from flexroad.tasks.segment.training_types import Progress, Round
from flexroad.tasks.types import Floats

if TYPE_CHECKING:
    import torch

THRESHOLDS = np.linspace(0.01, 0.99, 99)
"""What the threshold is chosen from."""


@dataclass(frozen=True, eq=False)
class Labels:
    """The labelled cells of one window."""

    where: NDArray[np.float32]
    """Column and row of the cells' centres, ``(m, 2)``, from -1 to 1 across the window."""
    road: NDArray[np.float32]
    """1 for road, else 0, ``(m,)``."""


@dataclass(frozen=True, eq=False)
class Windows:
    """Windows as the backbone sees them, and their labels."""

    tokens: NDArray[np.float16]
    """``(n, h, w, features)``; may lie on disk."""
    labels: Sequence[Labels]
    tiles: Sequence[str]
    """Where they come from."""

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
    """How to learn."""

    epochs: int = Field(100, ge=1, description="at most so many")
    patience: int = Field(8, ge=1, description="stop after so many epochs without a better validation loss")
    learning_rate: float = Field(0.003, gt=0, description="AdamW's step, on standardised tokens")
    weight_decay: float = Field(0.01, ge=0, description="AdamW's decay")
    balance: float = Field(
        0.5, ge=0, le=1, description="weight of road cells: (others per road cell) to this power"
    )
    batch: int = Field(4, ge=1, le=1024, description="windows at a time")
    seed: int = Field(0, ge=0, description="of the order of the windows")


class Regression:
    """A linear map that learns, by AdamW on the weighted cross entropy."""

    def __init__(self, windows: Windows, settings: Settings) -> None:
        import torch

        self.centre, self.spread = (torch.tensor(m, dtype=torch.float32) for m in _moments(windows.tokens))
        self.road_counts = ((windows.cells - windows.road) / windows.road) ** settings.balance
        self.weight = torch.zeros(len(self.centre), requires_grad=True)
        self.bias = torch.zeros((), requires_grad=True)
        self.adam: Any = torch.optim.AdamW(
            [self.weight, self.bias], lr=settings.learning_rate, weight_decay=settings.weight_decay
        )

    def folded(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Return weight and bias for tokens as they are."""
        weight = self.weight / self.spread
        return weight, self.bias - weight @ self.centre

    def line(self) -> Line:
        """Return what was learnt so far."""
        weight, bias = self.folded()
        return Line(weight.detach().numpy().copy(), bias.item())

    def loss(self, windows: Windows, which: NDArray[np.intp]) -> tuple[torch.Tensor, float]:
        """Return the cross entropy summed over the labelled cells of some windows, and the cells' weight."""
        import torch

        logits, road = at_cells(windows, which, *self.folded())
        counts = 1 + (self.road_counts - 1) * road
        entropy = torch.nn.functional.binary_cross_entropy_with_logits
        return entropy(logits, road, counts, reduction="sum"), float(counts.sum())

    def learn(self, windows: Windows, order: NDArray[np.intp], batch: int) -> float:
        """Go once over the windows; return the mean loss on the way."""
        sums = np.zeros(2)
        for which in _parts(order, batch):
            self.adam.zero_grad()
            loss, counts = self.loss(windows, which)
            (loss / counts).backward()
            self.adam.step()
            sums += loss.item(), counts
        return float(sums[0] / sums[1])

    def judge(self, windows: Windows, batch: int) -> float:
        """Return the mean loss."""
        import torch

        sums = np.zeros(2)
        with torch.no_grad():
            for which in _parts(np.arange(len(windows.labels)), batch):
                loss, counts = self.loss(windows, which)
                sums += loss.item(), counts
        return float(sums[0] / sums[1])


def regress(
    learnt: Windows, judged: Windows, settings: Settings, progress: Progress | None = None
) -> tuple[Line, tuple[Round, ...]]:
    """Learn on some windows; return the map that did best on the others, and the losses of all epochs."""
    regression = Regression(learnt, settings)
    rng = np.random.default_rng(settings.seed)
    history: list[Round] = []
    best = regression.line()
    lowest, since = np.inf, 0
    while len(history) < settings.epochs and since < settings.patience:
        loss = regression.learn(learnt, rng.permutation(len(learnt.labels)), settings.batch)
        history.append(Round(loss, regression.judge(judged, settings.batch)))
        since += 1
        if history[-1].validation_loss < lowest:
            best, lowest, since = regression.line(), history[-1].validation_loss, 0
        if progress:
            progress(len(history), settings.epochs, history[-1])
    return best, tuple(history)


def at_cells(
    windows: Windows, which: NDArray[np.intp], weight: torch.Tensor, bias: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the logits at the labelled cells of some windows, ``(m,)``, and 1 where they are road.

    The patches' logits are interpolated as those of pixels are in use: bilinear, corners not aligned.
    """
    import torch

    found = []
    for i in which:
        coarse = torch.from_numpy(windows.tokens[i].astype(np.float32)) @ weight + bias
        where = torch.from_numpy(windows.labels[i].where)
        fine = torch.nn.functional.grid_sample(
            coarse[None, None], where[None, None], padding_mode="border", align_corners=False
        )
        found.append(fine.ravel())
    road = np.concatenate([windows.labels[i].road for i in which])
    return torch.cat(found), torch.from_numpy(road)


def best_threshold(windows: Windows, line: Line) -> tuple[float, float]:
    """Return the probability that parts road from the rest with the best IoU, and that IoU."""
    import torch

    weight, bias = torch.from_numpy(line.weight), torch.tensor(line.bias)
    counts = np.zeros((2, len(THRESHOLDS) + 1))
    for i in range(len(windows.labels)):
        logits, road = at_cells(windows, np.array([i]), weight, bias)
        level = np.searchsorted(THRESHOLDS, logits.sigmoid().numpy(), side="right")
        for kind in (0, 1):
            counts[kind] += np.bincount(level[road.numpy() == kind], minlength=counts.shape[1])
    # How many cells of either kind lie at or above each threshold.
    wrong, right = counts[:, ::-1].cumsum(axis=1)[:, ::-1][:, 1:]
    iou = right / (counts[1].sum() + wrong)
    best = int(iou.argmax())
    return float(THRESHOLDS[best]), float(iou[best])


def _moments(tokens: NDArray[np.float16]) -> tuple[Floats, Floats]:
    """Return mean and standard deviation of each feature, ``(features,)``, a window at a time."""
    total, square = np.zeros(tokens.shape[-1]), np.zeros(tokens.shape[-1])
    for window in tokens:
        values = window.reshape(-1, tokens.shape[-1]).astype(np.float64)
        total += values.sum(axis=0)
        square += (values**2).sum(axis=0)
    n = tokens[..., 0].size
    centre = total / n
    # A feature that never changes tells nothing; it must not divide by 0.
    return centre, np.sqrt(np.maximum(square / n - centre**2, 1e-12))


def _parts(order: NDArray[np.intp], size: int) -> Iterator[NDArray[np.intp]]:
    for start in range(0, len(order), size):
        yield order[start : start + size]
