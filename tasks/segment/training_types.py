"""Types shared by the training command and the trainable segmentation methods."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from flexroad.tasks.types import Bools, TileData


@dataclass(frozen=True, eq=False)
class Sample:
    """One labelled tile for training or validation."""

    data: TileData
    """The tile with its halo."""
    road: Bools
    """Road according to the labels, ``(H, W)``."""
    labelled: Bools
    """Cells whose label is used, ``(H, W)``: inside survey and tile, outside the band along label edges."""


@dataclass(frozen=True)
class Round:
    """Losses after one boosting round or one epoch."""

    train_loss: float
    validation_loss: float
    """NaN if not measured."""


@dataclass(frozen=True, eq=False)
class Trained:
    """The result of training."""

    model: bytes
    """Content of the model file."""
    suffix: str
    """Suffix of the model file: ``.skops``, ``.safetensors``."""
    history: tuple[Round, ...]
    """One entry per round or epoch, in order."""


class Progress(Protocol):
    """Callback, called at the end of every round or epoch."""

    def __call__(self, done: int, of: int, last: Round) -> None:
        """Report round ``done`` (from 1) of at most ``of``."""
