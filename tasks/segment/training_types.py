"""What travels between the training command and the methods that learn."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from flexroad.tasks.types import Bools, TileData


@dataclass(frozen=True, eq=False)
class Sample:
    """One tile to learn from."""

    data: TileData
    """The tile and its halo."""
    road: Bools
    """Road by the labels, ``(H, W)``."""
    known: Bools
    """Cells whose label counts, ``(H, W)``: inside survey and tile, outside the band along label edges."""


@dataclass(frozen=True)
class Round:
    """How learning stood after one round (of boosting) or epoch (of a network)."""

    train_loss: float
    validation_loss: float
    """NaN where it was not measured."""


@dataclass(frozen=True, eq=False)
class Trained:
    """What a method learnt."""

    model: bytes
    """Content of the one file."""
    suffix: str
    """How such files end: ``.skops``, ``.safetensors``."""
    history: tuple[Round, ...]
    """One entry per round or epoch, the first first."""


class Progress(Protocol):
    """Told of every round as it ends; counts from 1."""

    def __call__(self, done: int, of: int, last: Round) -> None:
        """Take note of round ``done`` of at most ``of``."""
