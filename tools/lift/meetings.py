"""What lines of a network share where they meet: their levels, and heights beyond the surface."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial import cKDTree

from flexroad.pipeline.run.points import Heights
from flexroad.tasks.types import Bools, Floats
from flexroad.tools.lift.levels import ANY, Numbers, along, stretches
from flexroad.tools.lift.lines import Line

FAR_M = 1e12
"""A coordinate that is beyond all others."""
Key = tuple[str, ...]
"""The end of a line: lines that meet have equal ones."""


@dataclass(frozen=True, eq=False)
class _Line:
    ends: tuple[Key, Key]
    heights: Heights
    several: Bools
    number: int | None
    """Its level by its attributes."""
    junctions: tuple[str, str] | None
    """Ids of the junctions at its ends."""


@dataclass(frozen=True, eq=False)
class _Open:
    """A line that is not on the surface from end to end."""

    ends: tuple[Key, Key]
    heights: tuple[float, float]
    """Those where the surface ends, from its first and from its last point; NaN if it is not on it."""


@dataclass(eq=False)
class Meetings:
    """Levels at the ends of lines, and heights of ends beyond the surface.

    They are noted while a file is copied; `decide` makes them known for a second copy.
    """

    lines: list[_Line] = field(default_factory=list)
    open: list[_Open] = field(default_factory=list)
    ends: dict[Key, int] = field(default_factory=dict)
    junctions: dict[str, Counter[int]] = field(default_factory=dict)
    beyond: dict[Key, float] = field(default_factory=dict)
    """Heights of ends beyond the surface, if lines go on level there (m)."""
    nearest: cKDTree | None = None

    def note(
        self,
        line: Line,
        ends: tuple[Key, Key],
        heights: Heights,
        number: int | None,
        junctions: tuple[str, str] | None,
    ) -> None:
        """Remember a line if there are roads above roads at it."""
        several = heights.several
        if several.any():
            self.lines.append(_Line(ends, heights, several, number, junctions))

    def note_open(self, ends: tuple[Key, Key], z: Floats) -> None:
        """Remember a line if it has points without heights."""
        known = z[np.isfinite(z)]
        if len(known) < len(z):
            first, last = (known[0], known[-1]) if len(known) else (np.nan, np.nan)
            self.open.append(_Open(ends, (float(first), float(last))))

    def decide(self) -> None:
        """Give each end where several levels are the level of the lines that meet there.

        Lines that have a level by their attributes come first, then those that leave the place with several
        levels. One that does not leave it goes on as the lines that it meets, and else on the highest.
        """
        rest = list[_Line]()
        for line in sorted(self.lines, key=lambda each: each.number is None):
            if line.number is not None:
                self._settle(line, line.number, line.number)
            elif line.several.all():
                rest.append(line)
            else:
                numbers = along(line.heights, np.full(len(line.several), ANY))[1]
                self._settle(line, int(numbers[0]), int(numbers[-1]))
        while rest:
            left = list[_Line]()
            for line in rest:
                number = self.ends.get(line.ends[0], self.ends.get(line.ends[1]))
                if number is None:
                    left.append(line)
                else:
                    self._settle(line, number, number)
            if len(left) == len(rest):
                line = left.pop(0)
                number = int(along(line.heights, np.full(len(line.several), ANY))[1][0])
                self._settle(line, number, number)
            rest = left
        self._go_on_level()

    def _go_on_level(self) -> None:
        """Give the ends beyond the surface the heights at which the lines that meet there leave it."""
        rest = list[_Open]()
        for line in self.open:
            if np.isfinite(line.heights[0]):
                for end, height in zip(line.ends, line.heights, strict=True):
                    self.beyond.setdefault(end, height)
            else:
                rest.append(line)
        while rest:
            left = list[_Open]()
            for line in rest:
                found = [self.beyond[end] for end in line.ends if end in self.beyond]
                for end in line.ends if found else ():
                    self.beyond.setdefault(end, found[0])
                left += [] if found else [line]
            if len(left) == len(rest):
                break
            rest = left
        if self.beyond:
            places = np.array([[float(number) for number in end] for end in self.beyond])
            self.nearest = cKDTree(np.where(np.isfinite(places), places, FAR_M))

    def _settle(self, line: _Line, *numbers: int) -> None:
        for i, number in zip((0, -1), numbers, strict=True):
            if line.several[i]:
                level = self.ends.setdefault(line.ends[i], number)
                if line.junctions is not None:
                    self.junctions.setdefault(line.junctions[i], Counter())[level] += 1

    def wanted(self, heights: Heights, first: int | None, last: int | None) -> Numbers:
        """Return the wanted level of each point of a line with known levels at its ends."""
        several = heights.several
        wanted = np.full(len(several), ANY)
        for start, end in stretches(several):
            if end == len(several) and last is not None:
                wanted[start:end] = last
            if start == 0 and first is not None:
                wanted[start:end] = first
        if last is not None and several[-1]:
            wanted[-1] = last
        return wanted

    def level(self, junction: str) -> int:
        """Return the level of a junction: that of most lines that end there."""
        numbers = self.junctions.get(junction)
        return numbers.most_common(1)[0][0] if numbers else 0

    def going_on(self, line: Line, ends: tuple[Key, Key] | None, z: Floats) -> Floats:
        """Return the heights of a line that goes on level beyond the surface; None as ends: of an area."""
        known = np.isfinite(z)
        if known.all() or self.nearest is None:
            return z
        if ends is None:
            open_ = ~known & np.isfinite(line.x + line.y)
            _, index = self.nearest.query(np.column_stack([line.x, line.y])[open_])
            z = z.copy()
            z[open_] = np.array(list(self.beyond.values()))[index]
            return z
        z = z.copy()
        for i, end in zip((0, -1), ends, strict=True):
            z[i] = self.beyond.get(end, z[i]) if np.isnan(z[i]) else z[i]
        known = np.isfinite(z)
        return np.interp(line.s, line.s[known], z[known]) if known.any() else z
