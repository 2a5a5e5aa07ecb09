"""Lines on the surface: where their heights are taken, which vertices they need, and how steep they are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flexroad.tasks.types import Bools, Floats
from flexroad.tools.lift.levels import stretches
from flexroad.tools.lift.profile import vertices
from flexroad.tools.lift.types import Steep

STEP_M = 0.5
"""Largest distance of points at which the heights of a line are taken (m)."""
LONGEST_M = 1e8
"""Two vertices are no farther from each other on the earth (m)."""
MOST_POINTS = 1_000_000
"""Of a line; longer ones have points at larger distances, so that wrong ones do not fill the memory."""


@dataclass(frozen=True, eq=False)
class Line:
    """The vertices of a line, and points between them; n in all."""

    x: Floats
    """``(n,)``, in the coordinates of the file."""
    y: Floats
    s: Floats
    """``(n,)``, distance along the line (m)."""
    own: Bools
    """``(n,)``, whether a point is a vertex of the line."""

    @classmethod
    def of(cls, x: Floats, y: Floats, metres: tuple[float, float] = (1.0, 1.0), step: float = STEP_M) -> Line:
        """Return a line with points between its vertices, at most ``step`` from each other (m).

        - `x`, `y` ``(k,)``: its vertices.
        - `metres`: length of a unit of x and of y (m).
        """
        with np.errstate(over="ignore", invalid="ignore"):
            away = np.nan_to_num(np.hypot(np.diff(x) * metres[0], np.diff(y) * metres[1]))
        away = np.minimum(away, LONGEST_M)
        steps = np.minimum(away / step, MOST_POINTS)
        steps *= min(1.0, MOST_POINTS / max(float(steps.sum()), 1.0))
        number = np.maximum(np.ceil(steps - 1e-9), 1).astype(np.intp)
        places = np.concatenate([[0], np.cumsum(number)])
        every = np.arange(places[-1] + 1)
        own = np.zeros(len(every), np.bool_)
        own[places] = True
        s = np.concatenate([[0.0], np.cumsum(away)])
        at = [np.interp(every, places, values) for values in (x, y, s)]
        return cls(at[0], at[1], at[2], own)

    def needed(self, z: Floats, tolerance: float, add: bool = True) -> NDArray[np.intp]:
        """Return the indices of the vertices that a line needs to stay within a tolerance, its own included.

        - `z` ``(n,)``: heights (m); NaN where it keeps those that it has.
        - `tolerance`: largest distance of the line from these heights (m).
        - `add`: whether it gets vertices that it does not have.
        """
        if not add or len(z) < 3:
            return np.flatnonzero(self.own)
        known = np.isfinite(z)
        around = np.concatenate([[True], known, [True]])
        ends = known & ~(around[:-2] & around[2:])
        index = vertices(self.s, np.where(known, z, 0.0), self.own | ends, tolerance)
        return index[known[index] | self.own[index]]

    def grades(self, z: Floats, limit: float | None) -> tuple[float, tuple[Steep, ...]]:
        """Return the largest grade (m/m), NaN if none is known, and the steepest place of each steep part."""
        length = np.diff(self.s)
        at = np.flatnonzero((length > 0) & np.isfinite(np.diff(z)))
        grade = np.abs(np.diff(z)[at]) / length[at]
        if not len(at):
            return np.nan, ()
        places = list[Steep]()
        for most in steepest(grade, limit):
            x, y = ((values[at[most]] + values[at[most] + 1]) / 2 for values in (self.x, self.y))
            places.append(Steep("grade", float(grade[most]), float(x), float(y)))
        return float(grade.max()), tuple(places)

    def length_where(self, places: Bools) -> float:
        """Return the length (m) of some points of the line: each has half of the way to the next ones."""
        half = np.diff(self.s) / 2
        return float(np.sum(half * places[:-1]) + np.sum(half * places[1:]))


def largest(values: Floats | Sequence[float]) -> float:
    """Return the largest known value; NaN if there is none."""
    return float(np.fmax.reduce(values, initial=np.nan))


def steepest(values: Floats, limit: float | None) -> list[int]:
    """Return the index of the largest value of each stretch above a limit; without a limit, none."""
    if limit is None:
        return []
    return [start + int(np.argmax(values[start:end])) for start, end in stretches(values > limit)]
