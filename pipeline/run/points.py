"""What a sampler returns for points, points in another CRS, and the steps of tiles without common borders."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from flexroad.catalog.crs import same, transformer
from flexroad.tasks.quality.flagged import Bits
from flexroad.tasks.types import Bools, Floats

LARGEST_STEP_M = 0.05
"""Step between neighbouring tiles up to which they carry a road; tiles with common borders meet."""
STEP_REMEDY = "use a run of production, whose tiles have common borders"
Places = slice | Bools | NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class Heights:
    """Heights of n points on each level."""

    numbers: tuple[int, ...]
    """The k levels, ascending; 0, the ground, is one of them."""
    z: Floats
    """``(k, n)``, m; NaN where a level is not, and beyond the surface."""
    flags: Bits | None = None
    """``(k, n)``, flags of the surface by `tasks.quality.flagged`; None if it has none."""

    def __getitem__(self, places: Places) -> Heights:
        flags = None if self.flags is None else self.flags[:, places]
        return replace(self, z=self.z[:, places], flags=flags)

    def flags_on(self, numbers: NDArray[np.int8]) -> Bits:
        """Return the flags of the points on given levels, ``(n,)``."""
        found = np.zeros(len(numbers), np.uint16)
        if self.flags is not None:
            for number, row in zip(self.numbers, self.flags, strict=True):
                found[numbers == number] = row[numbers == number]
        return found

    @property
    def ground(self) -> Floats:
        """Heights of level 0, ``(n,)``, m."""
        return np.asarray(self.z[self.numbers.index(0)])

    @property
    def several(self) -> Bools:
        """Whether a point has another level than the ground, ``(n,)``."""
        others = [number != 0 for number in self.numbers]
        return np.asarray(np.isfinite(self.z[others]).any(axis=0))


@dataclass(frozen=True, eq=False)
class Answer:
    """Values at n points; NaN and empty strings off the finished tiles.

    Beyond the survey, where a surface is but has no data, only the tile is given.
    """

    height: Floats
    """``(n,)``, m."""
    normal: Floats
    """``(n, 3)``, upward unit normals: east, north, up."""
    tile: NDArray[np.str_]
    """``(n,)``, tile ids."""
    kind: NDArray[np.str_]
    """``(n,)``, ``road`` or ``terrain`` according to the segmented mask."""
    flags: Bits
    """``(n,)``, raised flags of the cells at the points, by `tasks.quality.flagged`."""
    earlier: tuple[str, ...] = ()
    """Ids of tiles whose values are of earlier sources or options (`RunSampler.earlier`)."""
    level: NDArray[np.int8] | None = None
    """``(n,)``, numbers of the levels that the values are of; None if all are of the highest."""
    numbers: tuple[int, ...] = (0,)
    """The levels of the tiles that have points."""


def to_crs(x: Floats, y: Floats, source: str | None, target: str) -> tuple[Floats, Floats]:
    """Return coordinates in another CRS; NaN where they cannot be transformed.

    - `x`, `y` ``(n,)``: first east, then north, whatever the order of the axes of the CRS.
    - `source`: none if they already are in the CRS ``target``.
    """
    if source is None or same(source, target):
        return x, y
    east, north = transformer(source, target).transform(x, y)
    finite = np.isfinite(east) & np.isfinite(north)
    return np.where(finite, east, math.nan), np.where(finite, north, math.nan)


def length_text(metres: float, digits: int = 0) -> str:
    """Return a length for the user, in millimetres below one metre."""
    return f"{1000 * metres:.{digits}f} mm" if metres < 1 else f"{metres:.2f} m"
