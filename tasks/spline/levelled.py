"""The surfaces of a tile with several levels: the ground, and decks above or tunnels below it.

Each level has a spline over the complete tile. Near an abutment, the ground has the surface of the level that
begins there, so that one spline crosses the abutment. The ground's own spline, with control points metres
apart, cannot follow the end of an embankment.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields

import numpy as np

from flexroad.catalog.grid import Bounds, Grid
from flexroad.tasks.spline.stepped import SteppedSurface
from flexroad.tasks.spline.surface import NurbsSurface
from flexroad.tasks.types import BLEND_M, Floats, Level, LevelSpline, Surface

GRADIENT_M = 0.01
"""Distance over which the slope of the weight of a level is computed (m)."""
STEEPEST = 1.6 / BLEND_M
"""Slopes of the weight above this are jumps (1/m): where the weight is smooth, its slope is smaller."""


@dataclass(frozen=True, eq=False)
class LevelledSurface(SteppedSurface):
    """The surfaces of all levels of a tile; its height, normal and steps belong to level 0.

    ``A`` are the control heights of level 0 alone. Within approaches its height differs from this spline.
    """

    levels: tuple[LevelSpline, ...] = ()
    """The other levels, by ascending number."""

    @classmethod
    def of(cls, spline: NurbsSurface, levels: tuple[LevelSpline, ...], cells: Grid) -> LevelledSurface:
        """Return the surface of level 0 with the other levels, without steps on the cells of a grid."""
        rows, cols = cells.shape
        return cls(
            **vars(spline),
            steps=np.zeros((rows, cols), np.float32),
            cells=cells,
            south_north=np.zeros((2, cols), np.float32),
            west_east=np.zeros((2, rows), np.float32),
            levels=levels,
        )

    def at(self, number: int) -> NurbsSurface:
        """Return the surface of a level; levels other than 0 have a road only where the level `covers`."""
        if number == 0:
            return self
        control = next(own.A for own in self.levels if own.level.number == number)
        own = {field.name: getattr(self, field.name) for field in fields(NurbsSurface)}
        return NurbsSurface(**own | {"A": control})

    @property
    def highest(self) -> Surface:
        """The surface of the highest level at each place."""
        return HighestSurface(self.bounds, self)

    def smooth(self, easting: Floats, northing: Floats) -> Floats:
        """Return the heights of level 0 without its steps (m) at points, in their broadcast shape."""
        return self._joined(super().smooth(easting, northing), easting, northing)

    def lattice(self, eastings: Floats, northings: Floats) -> Floats:
        """Return heights of level 0 (m) at every pair, ``(len(northings), len(eastings))``."""
        east, north = np.meshgrid(eastings, northings)
        heights = self._joined(NurbsSurface.lattice(self, eastings, northings), east, north)
        return np.asarray(heights + self.step(east, north))

    def slope(self, easting: Floats, northing: Floats) -> tuple[Floats, Floats]:
        """Return the derivatives of the height of level 0 without steps, by easting and northing (m/m)."""
        easting, northing = np.broadcast_arrays(np.asarray(easting, float), np.asarray(northing, float))
        heights = super().smooth(easting, northing)
        by_easting, by_northing = (np.array(part) for part in super().slope(easting, northing))
        for own in self.levels:
            weight = own.level.weight(easting, northing)
            near = weight > 0
            east, north, share = easting[near], northing[near], weight[near]
            other = self.at(own.level.number)
            off = other.height(east, north) - heights[near]
            for total, of_other, aside in zip(
                (by_easting, by_northing),
                other.slope(east, north),
                ((GRADIENT_M, 0.0), (0.0, GRADIENT_M)),
                strict=True,
            ):
                total[near] += share * (of_other - total[near]) + off * _rise(own.level, east, north, aside)
            heights[near] += share * off
        return by_easting, by_northing

    def _joined(self, heights: Floats, easting: Floats, northing: Floats) -> Floats:
        """Return heights of the spline of level 0 (m), blended with the other levels near their abutments."""
        east, north = np.broadcast_arrays(np.asarray(easting, float), np.asarray(northing, float))
        result = np.array(heights)
        for own in self.levels:
            weight = own.level.weight(east, north)
            near = weight > 0
            other = self.at(own.level.number).height(east[near], north[near])
            result[near] += weight[near] * (other - result[near])
        return result


@dataclass(frozen=True, eq=False)
class HighestSurface(Surface):
    """The highest level at each place: decks, and elsewhere the ground."""

    bounds: Bounds
    """The domain: west, south, east, north (m)."""
    every: LevelledSurface

    def height(self, easting: Floats, northing: Floats) -> Floats:
        """Return heights (m) at scattered points, in their broadcast shape."""
        return self._with_decks(self.every.height(easting, northing), easting, northing, NurbsSurface.height)

    def lattice(self, eastings: Floats, northings: Floats) -> Floats:
        """Return heights (m) at every pair, ``(len(northings), len(eastings))``."""
        places = np.meshgrid(eastings, northings)
        return self._with_decks(self.every.lattice(eastings, northings), *places, NurbsSurface.height)

    def normal(self, easting: Floats, northing: Floats) -> Floats:
        """Return upward unit normals at scattered points, ``(..., 3)``."""
        return self._with_decks(self.every.normal(easting, northing), easting, northing, NurbsSurface.normal)

    def _with_decks(
        self,
        values: Floats,
        easting: Floats,
        northing: Floats,
        of: Callable[[NurbsSurface, Floats, Floats], Floats],
    ) -> Floats:
        """Return values of level 0 at points; on higher levels the values of these levels."""
        east, north = np.broadcast_arrays(easting, northing)
        numbers, result = self.every.top(east, north), np.array(values)
        for number in np.unique(numbers[numbers > 0]).tolist():
            here = numbers == number
            result[here] = of(self.every.at(number), east[here], north[here])
        return result


def _rise(level: Level, easting: Floats, northing: Floats, aside: tuple[float, float]) -> Floats:
    """Return the derivative of the weight of a level in a direction (1/m), 0 at its jump at the abutment."""
    east, north = aside
    ahead, behind = (level.weight(easting + s * east, northing + s * north) for s in (1, -1))
    rise = (ahead - behind) / (2 * GRADIENT_M)
    return np.where(np.abs(rise) > STEEPEST, 0.0, rise)
