"""Types shared by the training command and the trainable segmentation method."""

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
class Epoch:
    """Losses after one epoch."""

    train_loss: float
    validation_loss: float


@dataclass(frozen=True, eq=False)
class Trained:
    """The result of training."""

    model: bytes
    """Content of the model file."""
    suffix: str
    """Suffix of the model file: ``.safetensors``."""
    history: tuple[Epoch, ...]
    """One entry per epoch, in order."""


class Progress(Protocol):
    """Callback, called at the end of every epoch."""

    def __call__(self, done: int, of: int, last: Epoch) -> None:
        """Report epoch ``done`` (from 1) of at most ``of``."""
