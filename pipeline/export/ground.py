"""Heights of a run's roads, from the surfaces of its tiles, of which a process keeps a few in memory.

Formats of smooth surfaces, and those along roads, have the spline without the steps of kerbs, walls and banks
beside roads. `Ground.step` and the texts here say by how much that differs from the surface of the run.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from flexroad.catalog import Bounds, Grid
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.run.finished import FinishedTile
from flexroad.tasks.spline.stepped import SteppedSurface, without_steps
from flexroad.tasks.types import Bools, Floats, Surface

SURFACES, ESTIMATES = 128, 32
"""Numbers of tiles of which a process keeps surface (some 0.4 MB each) and error estimates (0.6 MB)."""
SMOOTH = "the surface without kerbs and walls"
STEPS_SHOWN_M = 0.01
"""Height of steps that are left out from which the user is told (m)."""


def steps_left_out(steps_m: float | None) -> str:
    """Return the end of a line for the user about the largest step (m); empty if it is too small."""
    if steps_m is None or steps_m < STEPS_SHOWN_M:
        return ""
    return f"; with kerbs and walls it differs by up to {steps_m:.2f} m, where the run has no road"


@dataclass(frozen=True)
class GroundTile:
    """A finished tile by the name of its assessment, which depends on its surface and on its input."""

    id: str
    name: str
    tile: FinishedTile = field(compare=False, repr=False)

    @classmethod
    def of(cls, tile: FinishedTile) -> GroundTile:
        """Return that of a tile."""
        return cls(tile.id, tile.snapshot.nodes["assess"], tile)

    @property
    def grid(self) -> Grid:
        """The cells of the tile."""
        return self.tile.tile.grid

    @property
    def unread(self) -> FinishedTile:
        """The tile without the results that were read, which would stay in memory with it."""
        return replace(self.tile)


@dataclass(frozen=True)
class Ground:
    """The common ground of some finished tiles, without the steps beside their roads.

    A road along a centre line may be wider than that of the mask. It goes on beside it without a kerb.
    """

    tiles: tuple[GroundTile, ...]

    def height(self, easting: Floats, northing: Floats) -> Floats:
        """Return heights (m) at points (m, in the run's CRS), in their broadcast shape.

        NaN off the tiles and beyond the survey. Where tiles meet, the first one with a height counts.

        Raises
        ------
        ConfigError
            If a result of a tile cannot be read, or the tile has changed.
        """
        return self._first(_Patch.height, easting, northing)

    def step(self, easting: Floats, northing: Floats) -> Floats:
        """Return by how much the surface with steps is higher (m); the rest is as of `height`."""
        return self._first(_Patch.step, easting, northing)

    def _first(
        self, of: Callable[[_Patch, Floats, Floats], Floats], easting: Floats, northing: Floats
    ) -> Floats:
        easting, northing = np.broadcast_arrays(easting, northing)
        values = np.full(easting.shape, np.nan)
        for tile in self.tiles:
            here = np.isnan(values) & _within(tile.grid.bounds, easting, northing)
            if here.any():
                values[here] = of(_patch(tile), easting[here], northing[here])
        return values

    def error(self, easting: Floats, northing: Floats) -> tuple[Floats, NDArray[np.uint8]]:
        """Return the estimated error (m) of the surface and its `tasks.quality.support.Support`, ``(n,)``.

        They are those of the cell at each point. NaN and 0 where no surface is, or its input is gone.
        """
        error, support = np.full(easting.shape, np.nan), np.zeros(easting.shape, np.uint8)
        for tile in self.tiles:
            here = (support == 0) & _within(tile.grid.bounds, easting, northing)
            estimate = _estimate(tile) if here.any() else None
            if estimate is not None:
                cells = tile.grid.cells(easting[here], northing[here])
                error[here], support[here] = (values[cells] for values in estimate)
        return error, support


@dataclass(frozen=True, eq=False)
class _Patch:
    grid: Grid
    surface: Surface
    outside: Bools
    """Cells beyond the survey, ``(H, W)``."""

    def height(self, easting: Floats, northing: Floats) -> Floats:
        beyond = self.outside[self.grid.cells(easting, northing)]
        return np.where(beyond, np.nan, without_steps(self.surface).height(easting, northing))

    def step(self, easting: Floats, northing: Floats) -> Floats:
        beyond = self.outside[self.grid.cells(easting, northing)]
        surface = self.surface
        steps = surface.step(easting, northing) if isinstance(surface, SteppedSurface) else 0.0
        return np.where(beyond, np.nan, steps)


def _within(bounds: Bounds, easting: Floats, northing: Floats) -> Bools:
    west, south, east, north = bounds
    within = (west <= easting) & (easting <= east) & (south <= northing) & (northing <= north)
    return np.asarray(within)


@lru_cache(maxsize=SURFACES)
def _patch(tile: GroundTile) -> _Patch:
    finished = tile.unread
    road = finished.road
    return _Patch(tile.grid, finished.surface, road.outside[road.grid.window(road.core)])


@lru_cache(maxsize=ESTIMATES)
def _estimate(tile: GroundTile) -> tuple[NDArray[np.float32], NDArray[np.uint8]] | None:
    """Return the estimates and the support of a tile; None if its input cannot be read any more."""
    try:
        error, support = tile.unread.cell_errors
    except ConfigError:
        return None
    return error.astype(np.float32), support
