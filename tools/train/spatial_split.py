"""Split tiles into training and validation tiles, in space, not at random.

Neighbouring tiles show the same streets, so a random split overestimates the quality of a model. Instead one
straight line divides the tiles, and cells near the validation side are not used for training.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from flexroad.catalog import Bounds, Grid, Tile
from flexroad.pipeline.errors import ConfigError
from flexroad.tasks.types import Bools

DIRECTIONS = 8
"""Number of directions of the line that are tried."""


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


def split(pieces: Sequence[Block], share: float, gap_m: float, seed: int) -> Split:
    """Split blocks by a straight line into a training side and a validation side.

    Eight directions of the line are tried in an order drawn from the seed. The first one with road and other
    ground on both sides is used.

    - `pieces`: at least two, all in one CRS.
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
