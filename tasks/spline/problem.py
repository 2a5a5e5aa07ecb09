"""The loss of the production fit of one tile, as arrays."""

from __future__ import annotations

from dataclasses import dataclass

from flexroad.tasks.spline.space import Space
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
