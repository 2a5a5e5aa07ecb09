"""The surface along roads of OpenDRIVE as OpenCRG files, beside the lifted file."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
import scipy
from numpy.typing import NDArray

from flexroad.catalog.ids import safe_name
from flexroad.tasks.errors import TaskError
from flexroad.tasks.export import opencrg
from flexroad.tasks.export.opendrive import crg_reference
from flexroad.tasks.lift.plan_view import PlanView
from flexroad.tasks.roads.along_line import HeightGrid, across, without_gaps
from flexroad.tasks.roads.reference_line import ReferenceLine
from flexroad.tasks.types import Floats

INCREMENT_M = 0.5
"""Distance of the rows of a file (m), about."""
SHORTEST_M = 2.0
"""Roads that are shorter have none (m)."""
MOST_HEIGHTS = 2_000_000
"""Roads that would have more have none: 40 km of two lanes."""
ROUNDS = 20
LONGEST_NAME = 100
"""Number of characters of a road's id in the name of its file."""


@dataclass(frozen=True, eq=False)
class CrgLine:
    """The line of a file and the places beside it."""

    line: ReferenceLine
    v: Floats
    x: Floats
    """``(len(line.x) * len(v),)``, m."""
    y: Floats

    def of_points(self, s: Floats, rows: NDArray[np.intp]) -> NDArray[np.intp]:
        """Return for each place what the nearest of some distances along the road have."""
        nearest = np.rint(np.interp(self.line.s, s, np.arange(len(s)))).astype(int)
        return np.repeat(rows[nearest], len(self.v))


def crg_line(plan: PlanView, length: float, reach: float) -> CrgLine | None:
    """Return the line of a road; None if it is too short or too large, or bends too much.

    Parameters
    ----------
    reach : float
        Distance of the outer lanes from the reference line (m).
    """
    if length < SHORTEST_M:
        return None
    count = round(length / INCREMENT_M)
    increment = np.floor(1000 * length / count) / 1000
    s = np.arange(count + 1) * increment
    # Readers take the distances between points as straight.
    for _ in range(ROUNDS):
        x, y, heading = plan.at(s)
        missing = increment - np.hypot(np.diff(x), np.diff(y))
        if not np.isfinite(missing).all() or np.abs(missing).max() < 1e-9:
            break
        s[1:] += np.cumsum(missing)
    else:
        return None
    if not np.isfinite(missing).all() or (np.diff(s) <= 0).any():
        return None
    curve = scipy.interpolate.CubicSpline(s, np.column_stack([x, y]))
    width = np.full(len(s), 2 * reach)
    line = ReferenceLine(x, y, heading, s, float(increment), width, s, curve, 0.0)
    v = across(line)
    if len(s) * len(v) > MOST_HEIGHTS:
        return None
    beside_x, beside_y = line.beside(v)
    return CrgLine(line, v, beside_x.ravel(), beside_y.ravel())


class CrgFiles:
    """The OpenCRG files of a lifted file, in a folder beside it."""

    def __init__(self, out: Path) -> None:
        stem = re.sub(r"(\.xodr)?(\.gz)?$", "", out.name, flags=re.IGNORECASE) or out.name
        self._folder = out.parent / f"{stem}_crg"
        self._names = set[str]()

    def write(self, road: str, crg: CrgLine, z: Floats, length: float) -> str | None:
        """Write the file of a road and return the element that refers to it; None without any height."""
        heights = without_gaps(crg.v, z.reshape(len(crg.line.x), len(crg.v)))
        try:
            data = opencrg.encode(HeightGrid(crg.line, crg.v, heights), "x, y and heights as in OpenDRIVE")
        except TaskError:
            return None
        name = safe_name(road)[:LONGEST_NAME]
        while name in self._names:
            name += "_"
        self._names.add(name)
        self._folder.mkdir(exist_ok=True)
        path = self._folder / f"{name}{opencrg.NAME}"
        path.write_bytes(data)
        attributes = crg_reference(crg.line, f"{self._folder.name}/{path.name}", length)
        return ET.tostring(ET.Element("CRG", attributes), "unicode").replace(" />", "/>")
