"""Part tiles into those to learn from and those to judge by: apart in space, not at random.

Neighbours show the same street twice: judged by tiles among those it learnt from, a model looks better than
it is. So the land is cut by one straight line, and cells near it are left out of learning.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from flexroad.catalog import Bounds, Grid, Tile
from flexroad.pipeline.errors import ConfigError
from flexroad.tasks.types import Bools

DIRECTIONS = 8


@dataclass(frozen=True)
class Block:
    """A tile, or a part of it, on one side of the cut."""

    tile: Tile
    bounds: Bounds
    """Where its labels count."""
    road: int
    """Labelled road cells."""
    ground: int
    """Labelled cells of no road."""


@dataclass(frozen=True)
class Split:
    """Both sides of the cut."""

    train: tuple[Block, ...]
    validate: tuple[Block, ...]
    gap_m: float
    """Cells nearer than this to the validation side are not learnt from."""

    def learnt(self, grid: Grid, bounds: Bounds) -> Bools:
        """Return the cells within the bounds and far enough from the validation side, ``(H, W)``."""
        cells = inside(grid, bounds)
        for piece in self.validate:
            west, south, east, north = piece.bounds
            wide = (west - self.gap_m, south - self.gap_m, east + self.gap_m, north + self.gap_m)
            cells &= ~inside(grid, wide)
        return cells


def inside(grid: Grid, bounds: Bounds) -> Bools:
    """Return the cells of a grid whose centres lie within bounds, ``(H, W)``."""
    west, south, east, north = bounds
    rows = (grid.northings > south) & (grid.northings < north)
    cols = (grid.eastings > west) & (grid.eastings < east)
    return np.asarray(rows[:, None] & cols)


def split(pieces: Sequence[Block], share: float, gap_m: float, seed: int) -> Split:
    """Cut the land into a part to learn from and one of about ``share`` to judge by.

    Of eight directions, in an order that the seed decides, the first one counts that leaves labels of both
    kinds on both sides.

    Parameters
    ----------
    pieces : sequence of Piece
        At least two, all in one plane.
    share : float
        Of the pieces that are for judging, 0 to 1; at least one is, and at least one is not.

    Raises
    ------
    ConfigError
        If no cut leaves road and other ground on both sides.
    """
    count = min(max(1, round(share * len(pieces))), len(pieces) - 1)
    for turn in np.random.default_rng(seed).permutation(DIRECTIONS):
        angle = 2 * math.pi * turn / DIRECTIONS
        along = [math.sin(angle) * (w + e) + math.cos(angle) * (s + n) for w, s, e, n in _bounds(pieces)]
        order = np.argsort(along, kind="stable")
        validate = tuple(pieces[i] for i in sorted(order[-count:]))
        train = tuple(pieces[i] for i in sorted(order[:-count]))
        if _both(train) and _both(validate):
            return Split(train, validate, gap_m)
    raise ConfigError(
        f"no straight cut leaves road and other ground on both sides of it: {len(pieces)} tiles with labels, "
        f"{sum(piece.road > 0 for piece in pieces)} of them with road; label more tiles"
    )


def split_tile(bounds: Bounds, share: float) -> tuple[Bounds, Bounds]:
    """Return two parts of one tile's bounds, for a catalog that has a single tile.

    The second, in the east or, of a tall tile, in the south, has ``share`` of the ground.
    """
    west, south, east, north = bounds
    if east - west >= north - south:
        middle = east - share * (east - west)
        return (west, south, middle, north), (middle, south, east, north)
    middle = south + share * (north - south)
    return (west, middle, east, north), (west, south, east, middle)


def _bounds(pieces: Sequence[Block]) -> Iterator[Bounds]:
    return (piece.bounds for piece in pieces)


def _both(pieces: Sequence[Block]) -> bool:
    return any(piece.road for piece in pieces) and any(piece.ground for piece in pieces)
