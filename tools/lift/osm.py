"""OpenStreetMap's XML (``.osm``), also of Lanelet2: nodes on the surface get a tag ``ele``."""

from __future__ import annotations

from array import array
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
from numpy.typing import NDArray

from flexroad.catalog.text import shown
from flexroad.pipeline.run.sampler import Heights
from flexroad.tasks.errors import TaskError
from flexroad.tasks.quality.flagged import passed
from flexroad.tasks.types import Floats
from flexroad.tools.lift import xml_text
from flexroad.tools.lift.lines import Line, largest
from flexroad.tools.lift.network import (
    ANY,
    GUESSED,
    NOWHERE,
    Network,
    Node,
    Numbers,
    along,
    level_of,
    tagged_level,
)
from flexroad.tools.lift.types import POINTS, Frame, HeightsAt, Lifted, Options, with_heights
from flexroad.tools.lift.xml_text import Part

STEP_M = 1.0
"""Heights along a way are taken at points that are at most this far apart (m)."""
DEGREES, LOCAL = ("lon", "lat"), ("local_x", "local_y")
"""Names of coordinates: attributes of nodes, or tags of Lanelet2."""

Indices = NDArray[np.intp]


def frame(source: Path) -> Frame:
    """Return the coordinate system of a file: longitude and latitude, or local coordinates of Lanelet2."""
    return Frame("EPSG:4326" if _names(source) == DEGREES else None)


def lift(source: Path, out: Path, heights: HeightsAt, options: Options) -> Iterator[Lifted]:
    """Copy a file with heights; yield the rows of the report."""
    streets = _Streets.read(source, _names(source))
    streets.find_heights(heights)
    copy = _Added(streets, options)
    named = [way for way in streets.ways if way.row]
    rows = [copy.row(way, line, found) for way, line, found in streets.lines(heights, named)]
    if options.beyond == "flat":
        streets.go_on_level()
    with xml_text.opened(source) as file, xml_text.written(out) as target:
        for text in copy.texts(xml_text.parts(file, {"node", "way"})):
            target.write(text)
    yield from rows


def _names(source: Path) -> tuple[str, str]:
    """Return the names of a file's coordinates."""
    local = False
    for part in xml_text.elements(source, {"node"}):
        if np.isfinite(_place(part.element, DEGREES)).all():
            return DEGREES
        local = local or bool(np.isfinite(_place(part.element, LOCAL)).all())
    return LOCAL if local else DEGREES


def _place(node: ET.Element, names: tuple[str, str]) -> tuple[float, float]:
    """Return the coordinates of a node; NaN if it is deleted or lacks them."""
    if node.get("visible") == "false" or node.get("action") == "delete":
        return np.nan, np.nan
    values = node.attrib if names == DEGREES else _tags(node)
    return _number(values.get(names[0])), _number(values.get(names[1]))


def _number(text: str | None) -> float:
    """Return the number in a text; NaN if the text is not a number."""
    try:
        return float(text or "nan")
    except ValueError:
        return np.nan


def _tags(element: ET.Element) -> dict[str, str]:
    return {tag.get("k", ""): tag.get("v", "") for tag in element.iter("tag")}


def _id(text: str | None) -> int:
    try:
        number = int(text or "")
    except ValueError:
        number = 2**63
    if abs(number) >= 2**63:
        raise TaskError(f"has the id {shown(text)}, which is not a whole number; correct it")
    return number


@dataclass(frozen=True, eq=False)
class _Way:
    id: str
    nodes: Indices
    """Indices of its nodes; -1 for a node that the file lacks."""
    level: int
    """Its level from its tags."""
    row: bool
    """Whether the way has a row in the report."""


@dataclass(frozen=True, eq=False)
class _Streets:
    """Nodes in the order of the file, and the ways with levels or a row in the report."""

    ids: NDArray[np.int64]
    x: Floats
    y: Floats
    before: Floats
    """Old heights of the nodes (m); NaN without."""
    ways: list[_Way]
    by_tags: bool
    """Whether ways without a level in their tags are on the ground, like roads of OpenStreetMap."""
    geographic: bool
    """Whether x and y are in degrees; else in metres."""
    z: Floats
    """New heights of the nodes (m); NaN where they keep their old heights."""
    network: Network = field(default_factory=Network)

    @classmethod
    def read(cls, source: Path, names: tuple[str, str]) -> _Streets:
        ids, values = array("q"), array("d")
        ways = list[tuple[str, NDArray[np.int64], int, bool]]()
        for part in xml_text.elements(source, {"node", "way"}):
            element = part.element
            if element.tag == "node":
                ids.append(_id(element.get("id")))
                ele = next((tag.get("v") for tag in element.iter("tag") if tag.get("k") == "ele"), None)
                values.extend((*_place(element, names), _number(ele)))
            else:
                tags = _tags(element)
                refs = np.array([_id(node.get("ref")) for node in element.iter("nd")], np.int64)
                ways.append((element.get("id", ""), refs, tagged_level(tags), "highway" in tags))
        own, table = np.array(ids, np.int64), np.array(values).reshape(-1, 3)
        x, y, before = (np.where(np.isfinite(column), column, np.nan) for column in table.T)
        streets = any(row for *_, row in ways)
        order, found = np.argsort(own, kind="stable"), list[_Way]()
        for name, refs, level, row in ways:
            if len(own) and len(refs) > 1 and (row or level or not streets):
                index = order[np.minimum(np.searchsorted(own, refs, sorter=order), len(own) - 1)]
                nodes = np.where(own[index] == refs, index, -1)
                found.append(_Way(name, nodes, level, row or not streets))
        return cls(own, x, y, before, found, streets, names == DEGREES, np.full(len(own), np.nan))

    def find_heights(self, heights: HeightsAt) -> None:
        """Give each node its height: of the ground, or of the level of its way."""
        for start in range(0, len(self.ids), POINTS):
            part = slice(start, start + POINTS)
            self.z[part] = heights(self.x[part], self.y[part]).ground
        keeps, meets = np.zeros((2, len(self.ids)), np.bool_)
        some = [way for way in self.ways if way.level or not self.by_tags]
        if not self.by_tags:
            for way, _, found in self.lines(heights, some):
                if found.several.any():
                    wanted = np.full(found.z.shape[1], level_of(found, way.level) or ANY, np.int8)
                    self.network.note(way.id, _ends(way), found, wanted)
            self.network.decide()
        for way, line, found in self.lines(heights, some):
            z, numbers, known = self.along(way, found)
            raised = (numbers != 0) & np.isfinite(z)
            raised = raised[line.own] & (way.nodes >= 0)
            self.z[way.nodes[raised]] = z[line.own][raised]
            if way.level < 0 and not known:
                keeps[way.nodes[way.nodes >= 0]] = True
        for way in self.ways:
            if way.level >= 0:
                meets[way.nodes[way.nodes >= 0]] = True
        # A tunnel of unknown level meets other roads on the ground.
        self.z[keeps & ~meets] = np.nan

    def lines(self, heights: HeightsAt, ways: list[_Way]) -> Iterator[tuple[_Way, Line, Heights]]:
        """Yield each way with points along it and the heights of the points on all levels."""
        pairs = ((way, self._line(way)) for way in ways)
        for (way, line), found in with_heights(pairs, lambda each: (each[1].x, each[1].y), heights):
            yield way, line, found

    def _line(self, way: _Way) -> Line:
        missing = way.nodes < 0
        x, y = (np.where(missing, np.nan, values[way.nodes]) for values in (self.x, self.y))
        return Line.of(x, y, self._metres(y), STEP_M)

    def _metres(self, y: Floats) -> tuple[float, float]:
        """Return the lengths of a unit of x and y (m) at the mean of the known y."""
        if not self.geographic or not np.isfinite(y).any():
            return 1.0, 1.0
        middle = np.radians(np.nanmean(y))
        # Series for the ellipsoid of WGS 84.
        east = 111412.84 * np.cos(middle) - 93.5 * np.cos(3 * middle)
        return float(east), float(111132.95 - 559.82 * np.cos(2 * middle) + 1.175 * np.cos(4 * middle))

    def along(self, way: _Way, heights: Heights) -> tuple[Floats, Numbers, bool]:
        """Return heights along a way, the numbers of their levels, and whether the way's level is known."""
        own = level_of(heights, way.level) if way.level else None
        level, ends = own or 0, NOWHERE
        if own is None and not self.by_tags:
            level, ends = self.network.levels.get(way.id, int(ANY)), self.network.ends(_ends(way))
        wanted = np.full(heights.z.shape[1], level, np.int8)
        return *along(heights, wanted, ends), own is not None or not way.level

    def go_on_level(self) -> None:
        """Give nodes beyond the surface the heights of the nearest nodes on it, along their ways."""
        network = Network()
        for way in self.ways:
            nodes = way.nodes[way.nodes >= 0]
            if np.isnan(self.z[nodes]).any():
                line = self._line(replace(way, nodes=nodes))
                network.open.append((nodes.tolist(), line.s[line.own], self.z[nodes]))
        network.decide()
        for node, height in network.beyond.items():
            self.z[node] = height


def _ends(way: _Way) -> tuple[Node, Node]:
    return int(way.nodes[0]), int(way.nodes[-1])


@dataclass(frozen=True, eq=False)
class _Added:
    """The additions of a copy to the file."""

    streets: _Streets
    options: Options
    segments: dict[tuple[int, int], list[tuple[float, float, float]]] = field(default_factory=dict)
    """New nodes (x, y, height) between two nodes, by the ids of these, the lower id first."""

    def row(self, way: _Way, line: Line, heights: Heights) -> Lifted:
        """Return the row of a way; note its new nodes."""
        z, numbers, known = self.streets.along(way, heights)
        surface = np.isfinite(z)
        if way.level < 0 and not known:
            z = np.full(len(z), np.nan)
        add = self.options.add_vertices is True
        index = line.needed(z, self.options.tolerance_m, add)
        self._note(way, line, index, z)
        grade, steep = line.grades(z, self.options.grade_limit)
        without = line.length_where(~surface)
        before = np.where(way.nodes < 0, np.nan, self.streets.before[way.nodes])
        return Lifted(
            way.id,
            length_m=float(line.s[-1]),
            without_ground_m=without,
            levels=tuple(np.unique(numbers[np.isfinite(z)]).tolist()),
            unknown_deck_m=0.0 if known else float(line.s[-1]) - without,
            before_m=largest(np.abs(before - z[line.own])),
            elevation_m=largest(np.abs(np.interp(line.s, line.s[index], z[index]) - z)),
            grade=grade,
            steep=steep,
            note=GUESSED if way.id in self.streets.network.guessed else "",
            flags=passed(heights.flags_on(numbers)),
        )

    def _note(self, way: _Way, line: Line, index: Indices, z: Floats) -> None:
        """Note the new nodes between consecutive nodes of a way, unless another way has noted them."""
        ends = np.flatnonzero(line.own)
        for i, (a, b) in enumerate(zip(way.nodes[:-1].tolist(), way.nodes[1:].tolist(), strict=True)):
            new = index[(index > ends[i]) & (index < ends[i + 1])]
            if len(new) and a >= 0 and b >= 0:
                first, last = int(self.streets.ids[a]), int(self.streets.ids[b])
                new = new if first < last else new[::-1]
                places = list(zip(*(values[new].tolist() for values in (line.x, line.y, z)), strict=True))
                self.segments.setdefault((min(first, last), max(first, last)), places)

    def texts(self, parts: Iterator[bytes | Part]) -> Iterator[bytes]:
        """Yield the text of the copy."""
        number, named, ids = 0, False, self._new_ids()
        for part in parts:
            if isinstance(part, bytes):
                yield part
            elif part.element.tag == "node":
                yield _with_ele(part, float(self.streets.z[number]))
                number += 1
            else:
                if ids and not named:
                    # New nodes are written before the first way: readers expect nodes first.
                    yield from self._new_nodes(ids)
                    named = True
                yield self._with_nodes(part, ids)

    def _new_ids(self) -> dict[tuple[int, int], list[int]]:
        """Return ids of new nodes: negative, as for nodes that OSM does not have, and below all others."""
        next_id = min(int(self.streets.ids.min(initial=0)), 0) - 1
        ids = dict[tuple[int, int], list[int]]()
        for segment, places in self.segments.items():
            ids[segment] = [next_id - i for i in range(len(places))]
            next_id -= len(places)
        return ids

    def _new_nodes(self, ids: dict[tuple[int, int], list[int]]) -> Iterator[bytes]:
        local = not self.streets.geographic
        for segment, numbers in ids.items():
            for name, (x, y, z) in zip(numbers, self.segments[segment], strict=True):
                tags = [("ele", f"{z:.3f}")]
                place = f'lat="{y:.9f}" lon="{x:.9f}"'
                if local:
                    place, tags = 'lat="" lon=""', [("local_x", f"{x:.4f}"), ("local_y", f"{y:.4f}"), *tags]
                inside = "".join(f'<tag k="{key}" v="{value}"/>' for key, value in tags)
                yield f'<node id="{name}" {place}>{inside}</node>\n'.encode()

    def _with_nodes(self, part: Part, ids: dict[tuple[int, int], list[int]]) -> bytes:
        """Return a way with the new nodes between its nodes."""
        nodes = part.element.findall("nd") if ids else []
        edits = []
        for a, b in pairwise(nodes):
            first, last = _id(a.get("ref")), _id(b.get("ref"))
            new = ids.get((min(first, last), max(first, last)), [])
            if new:
                end = part.spans[a][1]
                text = "".join(f'<nd ref="{name}"/>' for name in (new if first < last else new[::-1]))
                edits.append((end, end, text.encode()))
        return part.replaced(edits)


def _with_ele(part: Part, z: float) -> bytes:
    if not np.isfinite(z):
        return part.text
    for tag in part.element.iter("tag"):
        if tag.get("k") == "ele":
            return part.replaced([part.with_attributes(tag, {"v": f"{z:.3f}"})])
    return part.replaced([part.with_child(part.element, f'<tag k="ele" v="{z:.3f}"/>')])
