"""Networks of SUMO (``.net.xml``): heights in the shapes of edges, lanes and junctions."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from flexroad.catalog.text import shown
from flexroad.pipeline.run.sampler import Heights
from flexroad.tasks.errors import TaskError
from flexroad.tasks.quality.flagged import passed
from flexroad.tasks.types import Floats
from flexroad.tools.lift import xml_text
from flexroad.tools.lift.lines import STEP_M, Line, largest
from flexroad.tools.lift.network import (
    ANY,
    GUESSED,
    Network,
    Numbers,
    along,
    filled,
    level_of,
    of_levels,
    tagged_level,
)
from flexroad.tools.lift.types import Frame, HeightsAt, Lifted, Options, with_heights
from flexroad.tools.lift.xml_text import Part

NO_PROJECTION = ("", "!", "-", ".")
"""Values of ``projParameter`` of networks without a CRS."""
FAR_M = 1e12
"""A coordinate far beyond all others."""
DIGITS = 3
"""Decimal places of heights, and least number of decimal places of added vertices."""


def frame(source: Path) -> Frame:
    """Return the coordinate system of a network, from its element ``location``."""
    for part in xml_text.elements(source, {"location"}):
        x, y, z = _offset(part.element)
        crs = (part.element.get("projParameter") or "").strip()
        return Frame(None if crs in NO_PROJECTION else crs, -x, -y, -z)
    return Frame(None)


def lift(source: Path, out: Path, heights: HeightsAt, options: Options) -> Iterator[Lifted]:
    """Copy a network with heights; yield a row of the report for each edge.

    At roads above roads, or at the limit of the surface, the heights of a line depend on the lines that it
    meets. Then the copy is written a second time.
    """
    network = Network()
    copy = _Copy(_places(source), network, heights, options)
    rows = list(copy.written(source, out))
    if network.lines or network.open:
        network.decide()
        rows = list(replace(copy, decided=True).written(source, out))
    yield from rows


@dataclass(frozen=True, eq=False)
class _Shape:
    """The vertices of a line or an area, or the place of a junction."""

    element: ET.Element
    name: str
    """Attribute of the element: ``shape``, ``outlineShape``; ``z`` for the place of a junction."""
    vertices: tuple[str, ...]
    """Texts of the file: ``x,y`` or ``x,y,z``."""
    before: Floats
    """Old heights of the vertices; NaN without."""
    line: Line
    area: bool = False
    """Whether it is an outline; outlines get no new vertices."""

    @classmethod
    def of(cls, element: ET.Element, name: str, text: str, area: bool = False) -> _Shape | None:
        """Return a shape; None if it has no vertices."""
        vertices = tuple(text.split())
        if not vertices:
            return None
        try:
            values = [[float(number) for number in vertex.split(",")] for vertex in vertices]
        except ValueError:
            values = [[]]
        if not text.isascii() or {len(vertex) for vertex in values} - {2, 3}:
            named = f"{element.tag} {shown(element.get('id'))}"
            raise TaskError(f"has coordinates that are not numbers ({named}: {shown(text)}); correct them")
        table = np.array([[*vertex, np.nan][:3] for vertex in values])
        table[~np.isfinite(table)] = np.nan
        line = Line.of(table[:, 0], table[:, 1], step=np.inf if area else STEP_M)
        return cls(element, name, vertices, table[:, 2], line, area)

    @property
    def ends(self) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """The texts of the coordinates of its ends in plan."""
        first, last = (tuple(self.vertices[i].split(",")[:2]) for i in (0, -1))
        return first, last

    def text(self, index: NDArray[np.intp], z: Floats) -> str:
        """Return the text of some of its points with new heights; points without keep the old text."""
        number = np.cumsum(self.line.own) - 1
        decimals = [len(each.partition(".")[2]) for each in self.vertices[0].split(",")[:2]]
        digits = max(DIGITS, *decimals)
        parts = list[str]()
        for i in index.tolist():
            if self.line.own[i]:
                text = self.vertices[number[i]]
            else:
                text = f"{self.line.x[i]:.{digits}f},{self.line.y[i]:.{digits}f}"
            if np.isfinite(z[i]):
                text = f"{','.join(text.split(',')[:2])},{z[i]:.{DIGITS}f}"
            parts.append(text)
        return " ".join(parts)


_Piece = tuple[bytes | Part, list[_Shape]]
"""An edge or a junction with its shapes; all other text has no shapes."""


def _places(source: Path) -> dict[str, str]:
    """Return the text ``x,y`` of each junction."""
    places = dict[str, str]()
    for part in xml_text.elements(source, {"junction"}):
        if part.element.get("type") != "internal":
            x, y = (part.element.get(name, "") for name in "xy")
            places[part.element.get("id", "")] = f"{x},{y}"
    return places


def _of_edge(edge: ET.Element, places: Mapping[str, str]) -> Iterator[_Shape | None]:
    area = edge.get("function") == "walkingarea"
    for lane in edge.findall("lane"):
        yield _Shape.of(lane, "shape", lane.get("shape", ""), area)
        yield _Shape.of(lane, "outlineShape", lane.get("outlineShape", ""), True)
    ends = [places.get(edge.get(name, "")) for name in ("from", "to")]
    # An edge without a shape is straight, from junction to junction.
    yield _Shape.of(edge, "shape", edge.get("shape") or ("" if None in ends else " ".join(map(str, ends))))


def _of_junction(junction: ET.Element) -> Iterator[_Shape | None]:
    place = ",".join(junction.get(name, "") for name in ("x", "y", "z") if name in junction.attrib)
    yield _Shape.of(junction, "z", place, True)
    yield _Shape.of(junction, "shape", junction.get("shape", ""), True)


def _offset(location: ET.Element) -> tuple[float, float, float]:
    """Return the offset that has been added to coordinates: x, y and height (m)."""
    text = location.get("netOffset") or "0,0"
    try:
        x, y, z = (*map(float, text.split(",")), 0.0)[:3]
    except ValueError:
        x = y = z = np.nan
    if not np.isfinite([x, y, z]).all():
        raise TaskError(f"has the netOffset {shown(text)}, not two or three numbers; correct it")
    return x, y, z


def _points(piece: _Piece) -> tuple[Floats, Floats]:
    lines = [shape.line for shape in piece[1]]
    x, y = (np.concatenate([np.zeros(0), *(getattr(line, name) for line in lines)]) for name in "xy")
    return x, y


@dataclass(frozen=True, eq=False)
class _Copy:
    """A copy of a network with heights."""

    places: Mapping[str, str]
    """Places of the junctions."""
    network: Network
    heights: HeightsAt
    options: Options
    decided: bool = False
    """Whether levels and heights of nodes are already decided; else lines are noted for that."""

    def written(self, source: Path, out: Path) -> Iterator[Lifted]:
        """Write the copy; yield the rows of the report."""
        with xml_text.opened(source) as file, xml_text.written(out) as copy:
            pieces = map(self._piece, xml_text.parts(file, {"edge", "junction"}))
            for (part, shapes), heights in with_heights(pieces, _points, self.heights):
                if isinstance(part, bytes):
                    copy.write(part)
                    continue
                text, row = self._lifted(part, shapes, heights)
                copy.write(text)
                if row is not None:
                    yield row

    def _piece(self, part: bytes | Part) -> _Piece:
        if isinstance(part, bytes):
            return part, []
        if part.path != ("net",):
            return part.text, []
        element = part.element
        shapes = _of_edge(element, self.places) if element.tag == "edge" else _of_junction(element)
        return part, [shape for shape in shapes if shape is not None]

    def _lifted(self, part: Part, shapes: list[_Shape], heights: Heights) -> tuple[bytes, Lifted | None]:
        """Return an edge or junction with heights, and the row of an edge."""
        element = part.element
        level = tagged_level({each.get("key", ""): each.get("value", "") for each in element.iter("param")})
        own = level_of(heights, level) if level else None
        edits, lanes, start = dict[ET.Element, dict[str, str]](), list[Lifted](), 0
        for shape in shapes:
            end = start + len(shape.line.s)
            here = heights[start:end]
            z, numbers = self._heights(element, shape, here, own)
            without = shape.line.length_where(~np.isfinite(z))
            if level < 0 and own is None:
                # A tunnel of unknown level meets other roads only at its ends.
                z[1:-1] = np.nan
            start, taken = end, z
            if self.options.beyond == "flat" and self.decided:
                z = self._going_on(shape, z)
            elif self.options.beyond == "flat" and not shape.area and np.isnan(z).any():
                self.network.note_open(shape.ends, shape.line.s, z)
            index = shape.line.needed(z, self.options.tolerance_m, self.options.add_vertices is not False)
            self._edit(shape, index, z, edits)
            if shape.element.tag == "lane" and not shape.area:
                row = self._row(shape, taken, index, numbers)
                flags = passed(here.flags_on(numbers))
                lanes.append(replace(row, without_ground_m=without, flags=flags))
        text = part.replaced(part.with_attributes(each, values) for each, values in edits.items())
        if not lanes or element.get("function"):
            return text, None
        name = element.get("id", "")
        note = GUESSED if name in self.network.guessed else ""
        return text, _joined(name, lanes, bool(level) and own is None, note)

    def _heights(
        self, element: ET.Element, shape: _Shape, heights: Heights, own: int | None
    ) -> tuple[Floats, Numbers]:
        """Return the heights of the points of a shape, and the numbers of their levels."""
        size, name, network = len(shape.line.s), element.get("id", ""), self.network
        junctions = (element.get("from", ""), element.get("to", "")) if "from" in element.attrib else None
        if shape.area:
            # Edges within a junction are named ":JUNCTION_NUMBER".
            junction = name[1:].rpartition("_")[0] if name.startswith(":") else name
            wanted = np.full(size, network.level(junction), np.int8)
            z, numbers = along(heights, wanted)
            _complete(shape.line, z, numbers, wanted)
        elif self.decided:
            ends = network.ends(shape.ends)
            if shape.element is element and junctions:
                own_levels = np.array([network.level(each) for each in junctions], np.int8)
                first, last = of_levels(heights[np.array([0, -1])], own_levels).tolist()
                ends = first, last
            level = network.levels.get(name, ANY) if own is None else own
            z, numbers = along(heights, np.full(size, level, np.int8), ends)
        else:
            wanted = np.full(size, ANY if own is None else own, np.int8)
            if shape.element is not element and heights.several.any():
                network.note(name, shape.ends, heights, wanted, junctions)
            z, numbers = along(heights, wanted)
        return z, numbers

    def _going_on(self, shape: _Shape, z: Floats) -> Floats:
        """Return the heights of a shape that continues level beyond the surface."""
        if not shape.area:
            return filled(shape.line.s, z, self.network.ends(shape.ends, beyond=True))
        places = np.column_stack([shape.line.x, shape.line.y])
        open_ = np.isnan(z) & np.isfinite(places).all(axis=1)
        if open_.any() and self.network.beyond:
            z = z.copy()
            z[open_] = np.array(list(self.network.beyond.values()))[self._nearest.query(places[open_])[1]]
        return z

    @cached_property
    def _nearest(self) -> cKDTree:
        """The places of nodes beyond the surface."""
        places = np.array([[float(number) for number in node] for node in self.network.beyond])
        return cKDTree(np.where(np.isfinite(places), places, FAR_M))

    def _edit(
        self, shape: _Shape, index: NDArray[np.intp], z: Floats, edits: dict[ET.Element, dict[str, str]]
    ) -> None:
        """Add the new values of attributes of a shape's element."""
        values = edits.setdefault(shape.element, {})
        if not np.isfinite(z[index]).any():
            return
        if shape.name == "z":
            values["z"] = f"{z[0]:.{DIGITS}f}"
        elif shape.name in shape.element.attrib or len(index) > len(shape.vertices):
            values[shape.name] = shape.text(index, z)

    def _row(self, shape: _Shape, z: Floats, index: NDArray[np.intp], numbers: Numbers) -> Lifted:
        """Return the figures of a lane; NaN without heights of the surface."""
        line = shape.line
        grade, steep = line.grades(z, self.options.grade_limit)
        return Lifted(
            "",
            length_m=float(line.s[-1]),
            levels=tuple(np.unique(numbers[np.isfinite(z)]).tolist()),
            before_m=largest(np.abs(shape.before - z[line.own])),
            elevation_m=largest(np.abs(np.interp(line.s, line.s[index], z[index]) - z)),
            grade=grade,
            steep=steep,
        )


def _complete(line: Line, z: Floats, numbers: Numbers, wanted: Numbers) -> None:
    """Give the corners of an area beside its deck the height of the nearest corner on the deck."""
    beside = np.isfinite(z) & (numbers != wanted)
    on = np.flatnonzero(np.isfinite(z) & ~beside)
    for i in np.flatnonzero(beside) if len(on) else ():
        z[i] = z[on[np.argmin(np.hypot(line.x[on] - line.x[i], line.y[on] - line.y[i]))]]


def _joined(name: str, lanes: list[Lifted], unknown: bool, note: str) -> Lifted:
    """Return the row of an edge: the largest value of each figure over its lanes."""
    names = ("length_m", "without_ground_m", "before_m", "elevation_m", "grade")
    most: dict[str, Any] = {each: largest([getattr(lane, each) for lane in lanes]) for each in names}
    return Lifted(
        name,
        **most,
        levels=tuple(sorted({number for lane in lanes for number in lane.levels})),
        unknown_deck_m=most["length_m"] - most["without_ground_m"] if unknown else 0.0,
        steep=tuple(place for lane in lanes for place in lane.steep),
        note=note,
        flags=passed(np.array([lane.flags for lane in lanes], np.uint16)),
    )
