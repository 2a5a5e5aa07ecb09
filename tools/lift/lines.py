"""Lines on the surface: the points with heights, the needed vertices, and the grades."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from flexroad.tasks.compiled import compiled
from flexroad.tasks.types import Bools, Floats
from flexroad.tools.export.reference_line import stretches
from flexroad.tools.lift.types import Steep

STEP_M = 0.5
"""Heights along a line are taken at points that are at most this far apart (m)."""
LONGEST_M = 1e8
"""More than the largest distance of two vertices on the Earth (m)."""
MOST_POINTS = 1_000_000
"""Largest number of points of a line. On longer lines the points are farther apart, to limit the memory."""


@dataclass(frozen=True, eq=False)
class Line:
    """The vertices of a line, and points between them; n in all."""

    x: Floats
    """``(n,)``, x in the coordinates of the file."""
    y: Floats
    s: Floats
    """``(n,)``, distance along the line (m)."""
    own: Bools
    """``(n,)``, whether a point is a vertex of the line."""

    @classmethod
    def of(cls, x: Floats, y: Floats, metres: tuple[float, float] = (1.0, 1.0), step: float = STEP_M) -> Line:
        """Return a line with points between its vertices, at most ``step`` apart (m).

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
        """Return the indices of the vertices that a line needs to stay within a tolerance; it keeps its own.

        - `z` ``(n,)``: heights (m); NaN where it keeps its old heights.
        - `tolerance`: largest distance of the line from these heights (m).
        - `add`: whether vertices may be added.
        """
        if not add or len(z) < 3:
            return np.flatnonzero(self.own)
        known = np.isfinite(z)
        around = np.concatenate([[True], known, [True]])
        ends = known & ~(around[:-2] & around[2:])
        index = vertices(self.s, np.where(known, z, 0.0), self.own | ends, tolerance)
        return np.asarray(index[known[index] | self.own[index]])

    def grades(self, z: Floats, limit: float | None) -> tuple[float, tuple[Steep, ...]]:
        """Return the largest grade (m/m; NaN if unknown), and the steepest place of each steep part."""
        length = np.diff(self.s)
        at = np.flatnonzero((length > 0) & np.isfinite(np.diff(z)))
        grade = np.abs(np.diff(z)[at]) / length[at]
        if not len(at):
            return np.nan, ()
        x, y = ((values[at] + values[at + 1]) / 2 for values in (self.x, self.y))
        return float(grade.max()), steepest("grade", grade, limit, x, y)

    def length_where(self, places: Bools) -> float:
        """Return the length (m) of points of the line: each has half of the distance to its neighbours."""
        half = np.diff(self.s) / 2
        return float(np.sum(half * places[:-1]) + np.sum(half * places[1:]))


def largest(values: Floats | Sequence[float]) -> float:
    """Return the largest known value; NaN if all are unknown."""
    return float(np.fmax.reduce(values, initial=np.nan))


def steepest(
    kind: Literal["grade", "crossfall"], values: Floats, limit: float | None, x: Floats, y: Floats
) -> tuple[Steep, ...]:
    """Return the place of the largest value of each stretch above a limit; empty without a limit."""
    found = [] if limit is None else stretches(values > limit)
    most = [start + int(np.argmax(values[start:end])) for start, end in found]
    return tuple(Steep(kind, float(values[at]), float(x[at]), float(y[at])) for at in most)


@compiled()
def vertices(s: Floats, z: Floats, kept: Bools, tolerance: float) -> NDArray[np.intp]:
    """Return the indices of the points that a line needs to stay within a tolerance.

    - `s`, `z` ``(n,)``: distances along the line and heights (m).
    - `kept` ``(n,)``: the points that always stay; the first and the last point must be among them.
    - `tolerance`: largest distance of the line from the heights of the removed points (m).
    """
    chosen, start, last = [0], 0, len(s) - 1
    while start < last:
        end = start + 1
        # Limits of the slope from the start: the line stays within the tolerance of all points so far.
        low, high = -np.inf, np.inf
        while True:
            away = s[end] - s[start]
            rise = z[end] - z[start]
            if kept[end] or end == last:
                if away > 0 and not low <= rise / away <= high and end - 1 > start:
                    end -= 1
                break
            if away > 0:
                if not low <= rise / away <= high and end - 1 > start:
                    end -= 1
                    break
                low, high = max(low, (rise - tolerance) / away), min(high, (rise + tolerance) / away)
            end += 1
        chosen.append(end)
        start = end
    return np.array(chosen)
