"""The loss of the production fit of one tile, as arrays."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from flexroad.catalog.grid import Grid
from flexroad.tasks.spline.space import Space
from flexroad.tasks.spline.stepped import Beside
from flexroad.tasks.types import Bools, Floats


@dataclass(frozen=True, eq=False)
class Problem:
    """The loss of one tile, and the control heights to start from."""

    space: Space
    heights: Floats
    """Heights to fit above the datum, ``(H, W)``, m; NaN cells are ignored."""
    weight: Floats
    """Weight of the height differences, ``(H, W)``, before the division by the number of cells."""
    stiffness: Floats
    """Weight of the squared curvature, ``(H, W)``, m3, before that division."""
    first: Floats
    """Control heights at the start, ``(m, n)``, m above the datum."""
    held: Bools
    """Control points that keep their height, ``(m, n)``."""
    datum: float
    """Height above sea level that has been subtracted from all heights (m)."""

    @property
    def shape(self) -> tuple[object, ...]:
        """What problems of one batch have in common: cells, degrees, and the knots' position among them."""
        s = self.space
        ends = (s.knots_u[0], s.knots_v[0], s.u[0], s.v[0], s.u[-1], s.v[-1])
        return (self.heights.shape, s.points, s.degree, s.unit_m, *map(float, ends))


@dataclass(frozen=True, eq=False)
class TileProblem:
    """The loss of one tile without its splines, which follow from the grid and the options: to be stored."""

    grid: Grid
    """The tile's core."""
    heights: Floats
    weight: Floats
    stiffness: Floats
    first: Floats
    held: Floats
    """Heights above sea level that control points keep, ``(m, n)``, m; NaN where they are fitted."""
    datum: float
    beside: Bools | None = None
    """This and the next four are the arrays of `ground`; None for a surface without steps."""
    beside_dsm: Floats | None = None
    beside_dtm: Floats | None = None
    south_north: Floats | None = None
    west_east: Floats | None = None

    @property
    def ground(self) -> Beside | None:
        """The heights beside the streets."""
        arrays = self.beside, self.beside_dsm, self.beside_dtm, self.south_north, self.west_east
        return None if any(array is None for array in arrays) else Beside(*arrays)  # type: ignore[arg-type]

    def with_ground(self, ground: Beside | None) -> TileProblem:
        """Return the problem with heights beside the streets."""
        if ground is None:
            return self
        return replace(
            self,
            beside=ground.cells,
            beside_dsm=ground.dsm,
            beside_dtm=ground.dtm,
            south_north=ground.south_north,
            west_east=ground.west_east,
        )

    def on(self, space: Space) -> Problem:
        """Return the loss over the splines of the tile."""
        held = np.isfinite(self.held)
        return Problem(space, self.heights, self.weight, self.stiffness, self.first, held, self.datum)
