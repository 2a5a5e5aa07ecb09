"""The network solver: the level of each line of a network, and its heights beyond the surface.

Lines (roads, lanes, ways) meet at nodes. The candidates of a line are the levels that the run has along it.
A known level or height is passed on through nodes to lines where it is unknown. OpenDRIVE, SUMO and OSM note
their lines here and then call `decide`. Features do not meet: they need only `along` and `filled`.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from flexroad.pipeline.run.sampler import Heights
from flexroad.tasks.roads.attributes import OSM_TAGS, level_numbers
from flexroad.tasks.types import Floats
from flexroad.tools.export.reference_line import stretches

ANY = np.int8(-128)
"""An unknown wanted level."""
SAME_M = 0.25
"""Levels whose heights at a node differ by less meet there (m), such as deck and ground at an abutment."""
NOWHERE = (np.nan, np.nan)
GUESSED = "several levels from end to end, and nothing that it meets says which it is on; it has the highest"

Numbers = NDArray[np.int8]
Node = Any
"""A place where lines meet, hashable: lines that meet have equal nodes."""
Ends = tuple[float, float]


def along(heights: Heights, wanted: Numbers, ends: Ends = NOWHERE) -> tuple[Floats, Numbers]:
    """Return the heights of points along a line, and the numbers of their levels.

    A known wanted level is taken, or level 0 if the point lacks that level. On a stretch with several levels
    and an unknown wanted level, the level is taken with which the grade changes least across the stretch. A
    line with several levels from end to end is on the highest.

    - `heights`: heights of n points in their order along a line.
    - `wanted` ``(n,)``: numbers of levels, or `ANY`.
    - `ends`: heights of the nodes at its ends; NaN where unknown. The first and the last stretch meet them.
    """
    z, numbers = heights.ground.copy(), np.zeros(len(wanted), np.int8)
    rows = {k: row for k, row in zip(heights.numbers, heights.z, strict=True) if k != 0}
    several = heights.several
    for number, row in rows.items():
        chosen = np.isfinite(row) & (wanted == number)
        z[chosen], numbers[chosen] = row[chosen], number
    for start, end in stretches(several & (wanted == ANY)):
        here, around = slice(start, end), slice(max(start - 2, 0), end + 2)
        candidates = {0: z[here].copy()}
        candidates |= {k: row[here] for k, row in rows.items() if np.isfinite(row[here]).all()}
        nodes = (ends[0] if start == 0 else np.nan, ends[1] if end == len(z) else np.nan)
        alone = start == 0 and end == len(z) and np.isnan(nodes).all()
        bends = {k: 0.0 if alone else _bend(z, around, here, row) for k, row in candidates.items()}
        number = _best({k: _misfit((row[0], row[-1]), nodes) for k, row in candidates.items()}, bends)
        z[here], numbers[here] = candidates[number], number
    for i, node in zip((0, -1), ends, strict=True):
        if np.isfinite(node) and several[i]:
            own = {k: row[i] for k, row in {0: heights.ground, **rows}.items() if np.isfinite(row[i])}
            number = min(own, key=lambda k: (abs(own[k] - node), -k))
            z[i], numbers[i] = own[number], number
    return z, numbers


def complete(heights: Heights) -> dict[int, Floats]:
    """Return the heights of each level that all points have."""
    return {k: row for k, row in zip(heights.numbers, heights.z, strict=True) if np.isfinite(row).all()}


def _misfit(ends: Sequence[float], nodes: Sequence[float]) -> float:
    """Return the sum of the known height differences between the ends of a line and its nodes."""
    return float(sum(abs(a - b) for a, b in zip(ends, nodes, strict=True) if np.isfinite(a - b)))


def _best(misfits: Mapping[int, float], bends: Mapping[int, float]) -> int:
    """Return the smoothest level that meets the nodes; of equals, the highest."""
    least = min(misfits.values()) + SAME_M
    return min((k for k in misfits if misfits[k] <= least), key=lambda k: (bends[k], -k))


def _bend(z: Floats, around: slice, here: slice, values: Floats) -> float:
    """Return the sum of the changes of grade if a stretch has given heights; points are equidistant."""
    tried = z.copy()
    tried[here] = values
    part = tried[around]
    return float(np.nansum(np.abs(np.diff(part[np.isfinite(part)], 2))))


def of_levels(heights: Heights, numbers: Numbers) -> Floats:
    """Return the heights of points on given levels; NaN where a point does not have its level."""
    z = np.full(len(numbers), np.nan)
    for number, row in zip(heights.numbers, heights.z, strict=True):
        z[numbers == number] = row[numbers == number]
    return z


def levels_of(heights: Heights, sign: int) -> list[int]:
    """Return the numbers of the levels of n points with a sign: bridges or tunnels."""
    rows = zip(heights.numbers, heights.z, strict=True)
    return [number for number, row in rows if number * sign > 0 and np.isfinite(row).any()]


def level_of(heights: Heights, number: int) -> int | None:
    """Return the level of a bridge or tunnel at n points; None if no point has a level of its kind.

    Sources may number the decks of one place differently, so the nearest number of the same sign is taken.
    """
    own = levels_of(heights, number)
    return min(own, key=lambda each: (abs(each - number), abs(each))) if own else None


def tagged_level(tags: Mapping[str, str]) -> int:
    """Return the level that tags of OpenStreetMap name: above 0 on a bridge, below 0 in a tunnel."""
    return _tagged_level(tuple((tag, tags[tag]) for tag in OSM_TAGS if tag in tags))


@lru_cache(1000)
def _tagged_level(tags: tuple[tuple[str, str], ...]) -> int:
    return int(level_numbers(pd.DataFrame([dict(tags)]))[0][0]) if tags else 0


def filled(s: Floats, z: Floats, ends: Ends = NOWHERE) -> Floats:
    """Fill unknown heights: linear between known heights, constant beyond the first and last.

    - `s`, `z` ``(n,)``: distances along a line and heights (m); NaN where unknown.
    - `ends`: heights of the nodes at its ends; NaN where not known.
    """
    z = z.copy()
    z[0], z[-1] = (end if np.isnan(own) else own for own, end in zip((z[0], z[-1]), ends, strict=True))
    known = np.isfinite(z)
    return z if known.all() or not known.any() else np.where(known, z, np.interp(s, s[known], z[known]))


@dataclass(frozen=True, eq=False)
class _Line:
    """A line, with one candidate if its level is known."""

    name: str
    nodes: tuple[Node, Node]
    candidates: Mapping[int, tuple[Ends, float]]
    """For each possible level the heights at both ends, and the changes of grade between them."""
    numbers: tuple[int, int]
    """Levels at both ends, if its level is known."""
    tagged: bool
    """Whether its attributes give its level."""
    several: tuple[bool, bool]
    """For both ends, whether there is another level than the ground."""
    junctions: tuple[str, str] | None


@dataclass(eq=False)
class Network:
    """Levels and heights at nodes. Lines are noted while a file is read; `decide` finds the results."""

    lines: list[_Line] = field(default_factory=list)
    open: list[tuple[Sequence[Node], Floats, Floats]] = field(default_factory=list)
    """Lines that leave the surface: nodes (None if no line meets there), distances and heights at them."""
    levels: dict[str, int] = field(default_factory=dict)
    """Levels of the lines with several candidates, by name."""
    guessed: set[str] = field(default_factory=set)
    """Names of lines whose level nothing determines."""
    junctions: defaultdict[str, Counter[int]] = field(default_factory=lambda: defaultdict(Counter))
    """Levels of the lines that end at each junction with several levels."""
    heights: dict[Node, float] = field(default_factory=dict)
    """Heights at which lines pass nodes (m)."""
    beyond: dict[Node, float] = field(default_factory=dict)
    """Heights of nodes beyond the surface, where lines continue level (m)."""
    _votes: defaultdict[str, Counter[int]] = field(default_factory=lambda: defaultdict(Counter))
    _numbers: dict[Node, int] = field(default_factory=dict)
    _joined: dict[Node, Node] = field(default_factory=dict)

    def join(self, a: Node, b: Node) -> None:
        """Merge two nodes."""
        a, b = self._node(a), self._node(b)
        if a != b:
            self._joined[a] = b

    def _node(self, node: Node) -> Node:
        while node in self._joined:
            node = self._joined[node]
        return node

    def ends(self, nodes: Sequence[Node], beyond: bool = False) -> Ends:
        """Return the heights of lines at two nodes, also beyond the surface on request; NaN if unknown."""
        known = self.beyond if beyond else self.heights
        first, last = (known.get(self._node(node), np.nan) for node in nodes)
        return first, last

    def note(
        self,
        name: str,
        nodes: tuple[Node, Node],
        heights: Heights,
        wanted: Numbers,
        junctions: tuple[str, str] | None = None,
    ) -> None:
        """Remember a line. Lines with the same name, such as the lanes of an edge, are on one level.

        - `wanted`: as in `along`.
        - `junctions`: ids of the junctions at its ends.
        """
        rows, tagged = complete(heights), bool((wanted != ANY).any())
        z, numbers = along(heights, wanted)
        several = heights.several
        if len(rows) < 2 or tagged:
            rows = {int(numbers[0]): z}
            self._votes[name].update(numbers[several].tolist())
        candidates = {
            k: ((float(row[0]), float(row[-1])), _bend(row, slice(None), slice(None), row))
            for k, row in rows.items()
        }
        ends = (int(numbers[0]), int(numbers[-1])), tagged, (bool(several[0]), bool(several[-1]))
        self.lines.append(_Line(name, nodes, candidates, *ends, junctions))

    def note_open(self, nodes: tuple[Node, Node], s: Floats, z: Floats) -> None:
        """Remember a line that may leave the surface: its ends, and the ends of its part on the surface."""
        known = np.flatnonzero(np.isfinite(z))
        at = [0, *known[[0, -1] if len(known) else []].tolist(), -1]
        self.open.append(((nodes[0], *[None] * (len(at) - 2), nodes[1]), s[at], z[at]))

    def decide(self) -> None:
        """Give each line a level, and each node a height.

        Lines with a known level come first; among them, lines with attributes. Then follow lines that meet
        known lines: of the levels that meet their nodes, they get the smoothest. If no line meets a known
        line, the first line is on the highest level.
        """
        rest = defaultdict[str, list[_Line]](list)
        for line in sorted(self.lines, key=lambda each: not each.tagged):
            if len(line.candidates) > 1:
                rest[line.name].append(line)
            else:
                (ends, _), *_ = line.candidates.values()
                self._settle(line, line.numbers, ends)
        while rest:
            ready = [name for name, lines in rest.items() if self._votes[name] or any(map(self._met, lines))]
            if not ready:
                ready = list(rest)[:1]
                self.guessed.update(ready)
            self.levels |= {name: self._level(name, rest[name]) for name in ready}
            for name in ready:
                number = self.levels[name]
                for line in rest.pop(name):
                    if number in line.candidates:
                        self._settle(line, (number, number), line.candidates[number][0])
        self._go_on_level()

    def _met(self, line: _Line) -> bool:
        return bool(np.isfinite(self.ends(line.nodes)).any())

    def _level(self, name: str, lines: Sequence[_Line]) -> int:
        """Return the level of lines with one name: as of its other lines, else by the nodes' heights."""
        common = set.intersection(*(set(line.candidates) for line in lines)) or set(lines[0].candidates)
        for number, _ in self._votes[name].most_common():
            if number in common:
                return number
        misfits, bends = dict.fromkeys(common, 0.0), dict.fromkeys(common, 0.0)
        for line in filter(self._met, lines):
            for k in common & set(line.candidates):
                ends, bend = line.candidates[k]
                misfits[k] += _misfit(ends, self.ends(line.nodes))
                bends[k] += bend
        return _best(misfits, bends)

    def _settle(self, line: _Line, numbers: tuple[int, int], heights: Ends) -> None:
        """Give the nodes of a line its heights and levels, if theirs are unknown."""
        for i, node in enumerate(map(self._node, line.nodes)):
            if np.isfinite(heights[i]):
                self.heights.setdefault(node, heights[i])
            number = self._numbers.setdefault(node, numbers[i])
            if line.junctions is not None and line.several[i]:
                self.junctions[line.junctions[i]][number] += 1

    def level(self, junction: str) -> int:
        """Return the level of a junction: the level of most lines that end there."""
        numbers = self.junctions.get(junction)
        return numbers.most_common(1)[0][0] if numbers else 0

    def _go_on_level(self) -> None:
        """Give nodes beyond the surface the heights at which their lines leave the surface."""
        rest = sorted(self.open, key=lambda line: not np.isfinite(line[2]).any())
        while rest:
            left = []
            for nodes, s, own in rest:
                known = [self.beyond.get(self._node(node), np.nan) for node in nodes]
                z = filled(s, np.where(np.isfinite(own), own, known))
                if not np.isfinite(z).any():
                    left.append((nodes, s, own))
                    continue
                for node, height in zip(nodes, z.tolist(), strict=True):
                    if node is not None:
                        self.beyond.setdefault(self._node(node), height)
            if len(left) == len(rest):
                break
            rest = left
