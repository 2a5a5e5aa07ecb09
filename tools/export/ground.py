"""Heights of a run's roads, from the surfaces of its tiles, of which a process keeps a few in memory.

Formats of smooth surfaces, and those along roads, have the spline without the steps of kerbs, walls and banks
beside roads. `Ground.step` and the texts here say by how much that differs from the surface of the run.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from flexroad.catalog import Bounds, Grid
from flexroad.pipeline.run.finished import GroundTile, estimate, flagged
from flexroad.pipeline.run.tile_steps import largest_tile_step
from flexroad.tasks.quality.flagged import passed
from flexroad.tasks.spline.levelled import LevelledSurface
from flexroad.tasks.spline.stepped import SteppedSurface
from flexroad.tasks.spline.surface import NurbsSurface
from flexroad.tasks.types import Bools, Floats, Surface
from flexroad.tools.export.along_route import PlaceLevels

SURFACES = 128
"""Number of tiles of which a process keeps the surface (some 0.4 MB each)."""
SMOOTH = "the surface without kerbs and walls"
STEPS_SHOWN_M = 0.01
"""Height of steps that are left out from which the user is told (m)."""


def steps_left_out(steps_m: float | None) -> str:
    """Return the end of a line for the user about the largest step (m); empty if it is too small."""
    if steps_m is None or steps_m < STEPS_SHOWN_M:
        return ""
    return f"; with kerbs and walls it differs by up to {steps_m:.2f} m, where the run has no road"


@dataclass(frozen=True)
class Ground:
    """The common ground of some finished tiles, without the steps beside their roads.

    A road along a centre line may be wider than that of the mask. It goes on beside it without a kerb.
    """

    tiles: tuple[GroundTile, ...]

    def height(self, easting: Floats, northing: Floats, levels: PlaceLevels | None = None) -> Floats:
        """Return heights (m) at points (m, in the run's CRS), in their broadcast shape.

        NaN off the tiles and beyond the survey. Where tiles meet, the first one with a height counts.

        - `levels`: the levels of the points, of which heights are; level 0 where the tile does not have it,
          but NaN in tubes. None: all of level 0.
        """
        return self._first(_Patch.height, easting, northing, levels)

    def step(self, easting: Floats, northing: Floats, levels: PlaceLevels | None = None) -> Floats:
        """Return by how much the surface with steps is higher (m); the rest is as of `height`."""
        return self._first(_Patch.step, easting, northing, levels)

    def largest_tile_step(
        self, easting: Floats, northing: Floats, inside: Bools, levels: PlaceLevels | None = None
    ) -> float:
        """Return the largest step (m) where neighbours of a grid of points lie on two tiles; 0 if none do.

        - `easting`, `northing` ``(n, m)``: in the run's CRS (m).
        - `inside` ``(n, m)``: the points that count.
        """
        first = np.full(easting.shape, -1)
        for number, tile in reversed(list(enumerate(self.tiles))):
            first[_within(tile.grid.bounds, easting, northing) & inside] = number
        index: NDArray[np.intp] = np.arange(easting.size).reshape(easting.shape)
        starts = np.concatenate([index[:-1].ravel(), index[:, :-1].ravel()])
        ends = np.concatenate([index[1:].ravel(), index[:, 1:].ravel()])
        places = np.stack([easting.ravel(), northing.ravel()])
        flat = None if levels is None else PlaceLevels(levels.number.ravel(), levels.own.ravel())
        return largest_tile_step(
            places[:, starts],
            places[:, ends],
            first.ravel()[starts],
            first.ravel()[ends],
            [tile.grid.bounds for tile in self.tiles],
            lambda tile, x, y, lines: _patch(self.tiles[tile]).height(x, y, flat and flat[starts[lines]]),
        )

    def _first(
        self,
        of: Callable[[_Patch, Floats, Floats, PlaceLevels | None], Floats],
        easting: Floats,
        northing: Floats,
        levels: PlaceLevels | None,
    ) -> Floats:
        easting, northing = np.broadcast_arrays(easting, northing)
        values = np.full(easting.shape, np.nan)
        for tile in self.tiles:
            here = np.isnan(values) & _within(tile.grid.bounds, easting, northing)
            if here.any():
                values[here] = of(
                    _patch(tile), easting[here], northing[here], None if levels is None else levels[here]
                )
        return values

    def error(
        self, easting: Floats, northing: Floats, levels: PlaceLevels | None = None
    ) -> tuple[Floats, NDArray[np.uint8]]:
        """Return the estimated error (m) of the surface and its `tasks.quality.support.Support`, ``(n,)``.

        They are those of the cell at each point, on its own level. NaN and 0 where no surface is, or its
        input is gone.
        """
        numbers = np.zeros(easting.shape, np.int8) if levels is None else levels.number * levels.own
        error, support = np.full(easting.shape, np.nan), np.zeros(easting.shape, np.uint8)
        for tile in self.tiles:
            within = (support == 0) & _within(tile.grid.bounds, easting, northing)
            for number in np.unique(numbers[within]).tolist():
                here = within & (numbers == number)
                estimates = estimate(tile, number)
                if estimates is not None:
                    cells = tile.grid.cells(easting[here], northing[here])
                    error[here], support[here] = (values[cells] for values in estimates)
        return error, support

    def flags(self, easting: Floats, northing: Floats, levels: PlaceLevels | None = None) -> int:
        """Return the flags that points pass (`tasks.quality.flagged.flag_names`), each on its own level."""
        numbers = np.zeros(easting.shape, np.int8) if levels is None else levels.number * levels.own
        bits = 0
        for tile in self.tiles:
            within = _within(tile.grid.bounds, easting, northing)
            for number in np.unique(numbers[within]).tolist():
                here = within & (numbers == number)
                bits |= passed(flagged(tile, number)[tile.grid.cells(easting[here], northing[here])])
        return bits


@dataclass(frozen=True, eq=False)
class _Patch:
    grid: Grid
    surface: Surface
    outside: Bools
    """Cells beyond the survey, ``(H, W)``."""

    def height(self, easting: Floats, northing: Floats, levels: PlaceLevels | None) -> Floats:
        surface = self.surface
        smooth = surface.smooth if isinstance(surface, SteppedSurface) else surface.height
        heights = np.array(smooth(easting, northing))
        for own, here in self._others(easting, northing, levels):
            heights[here] = own.height(easting[here], northing[here]) if own else np.nan
        return self._known(heights, easting, northing)

    def step(self, easting: Floats, northing: Floats, levels: PlaceLevels | None) -> Floats:
        surface = self.surface
        steps = np.zeros(easting.shape)
        if isinstance(surface, SteppedSurface):
            steps[:] = surface.step(easting, northing)
        for _, here in self._others(easting, northing, levels):
            steps[here] = 0.0
        return self._known(steps, easting, northing)

    def _known(self, values: Floats, easting: Floats, northing: Floats) -> Floats:
        return np.where(self.outside[self.grid.cells(easting, northing)], np.nan, values)

    def _others(
        self, easting: Floats, northing: Floats, levels: PlaceLevels | None
    ) -> Iterator[tuple[NurbsSurface | None, Bools]]:
        """Yield the surface of each level but 0 with the points that have it; None for an unknown tube."""
        if levels is None:
            return
        surface = self.surface
        splines = surface.levels if isinstance(surface, LevelledSurface) else ()
        known = {own.level.number: own.level for own in splines}
        for number in np.unique(levels.number[levels.number != 0]).tolist():
            here = levels.number == number
            if number in known:
                level, at = known[number], (easting, northing)
                # Beyond deck and approach, nothing holds this surface.
                assert isinstance(surface, LevelledSurface)
                yield surface.at(number), here & (levels.own | level.covers(*at) | (level.weight(*at) > 0))
            elif number < 0:
                yield None, here & levels.own


def _within(bounds: Bounds, easting: Floats, northing: Floats) -> Bools:
    west, south, east, north = bounds
    within = (west <= easting) & (easting <= east) & (south <= northing) & (northing <= north)
    return np.asarray(within)


@lru_cache(maxsize=SURFACES)
def _patch(tile: GroundTile) -> _Patch:
    finished = tile.unread
    road = finished.road
    return _Patch(tile.grid, finished.surface, road.outside[road.grid.window(road.core)])
