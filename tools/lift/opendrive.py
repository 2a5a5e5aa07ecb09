"""OpenDRIVE 1.4 to 1.8 (``.xodr``): elevation and superelevation of each road from the surface."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Literal
from xml.etree import ElementTree as ET

import numpy as np
from numpy.typing import NDArray

from flexroad.pipeline.run.sampler import Heights
from flexroad.tasks.errors import TaskError
from flexroad.tasks.quality.flagged import passed
from flexroad.tasks.types import Bools, Floats
from flexroad.tools.export.profiles import NONE, Profiles, cubic_pieces, value_at
from flexroad.tools.lift import plan_view, road_profiles, xml_text
from flexroad.tools.lift.lines import steepest
from flexroad.tools.lift.network import (
    ANY,
    GUESSED,
    NOWHERE,
    Network,
    Node,
    Numbers,
    along,
    complete,
    filled,
    levels_of,
    of_levels,
)
from flexroad.tools.lift.plan_view import numbers
from flexroad.tools.lift.road_profiles import AHEAD_M, CrossSections
from flexroad.tools.lift.types import NO_POINTS, Frame, HeightsAt, Lifted, Options, with_heights
from flexroad.tools.lift.xml_text import Part

ALONG_M, LEAST_ALONG = 1.0, 4
"""Distance of the cross-sections of a road (m), and their least number minus 1."""
ACROSS_M = 1.0
"""Distance of the points of a cross-section (m)."""
LEAST_ACROSS, MOST_ACROSS = 4, 80
"""Least and largest number of the points of a cross-section, minus 1."""
MOST_FINER, MOST_FINE = 8, 4000
"""In bends, cross-sections are closer by at most this factor, up to this number per road."""
LONGEST_M = 50_000.0
"""Longest road (m)."""
Structure = tuple[Literal["bridge", "tunnel"], float, float]
"""Kind, start and end of a bridge or tunnel, by distances along its road (m)."""
ALL_LEVEL = 'all lanes have level="true", as netconvert writes it: they stay flat across; write "false"'


@dataclass(frozen=True, eq=False)
class Road:
    """A road with the places of its cross-sections."""

    part: Part
    id: str
    s: Floats
    """``(n,)``: distances of the cross-sections, m."""
    t: Floats
    """``(m,)``: points of the cross-sections, m from the reference line."""
    x: Floats
    """``(n,)``: x of the reference line."""
    y: Floats
    heading: Floats
    extent: plan_view.Extent
    elevation: Floats
    """The road's old profile, ``(k, 5)``."""
    superelevation: Floats
    structures: tuple[Structure, ...]

    @property
    def inside(self) -> Bools:
        """The points of cross-sections on or next to the lanes, ``(n, m)``."""
        half = (self.t[1] - self.t[0]) / 2
        right, left = self.extent.right[:, None], self.extent.left[:, None]
        return np.asarray((self.t >= right - half) & (self.t <= left + half))

    @property
    def column(self) -> NDArray[np.intp]:
        """The point in the middle of the lanes of each cross-section, ``(n,)``."""
        middle = (self.extent.right + self.extent.left) / 2
        return np.asarray(np.abs(self.t - middle[:, None]).argmin(axis=1))

    @property
    def nodes(self) -> tuple[Node, Node]:
        """Nodes at its start and its end."""
        return (self.id, "start"), (self.id, "end")

    @property
    def links(self) -> Iterator[tuple[Node, Node]]:
        """Its ends that are linked with other roads, and the linked ends of these roads."""
        for name, node in zip(("predecessor", "successor"), self.nodes, strict=True):
            link = self.part.element.find(f"link/{name}")
            if link is not None and link.get("elementType") == "road":
                yield node, (link.get("elementId"), link.get("contactPoint"))

    def middle_and_line(self) -> tuple[Floats, Floats]:
        """Return x and y in the middle of the lanes, then on the reference line, ``(2 n,)`` each."""
        away = self.t[self.column]
        x, y = self.x - away * np.sin(self.heading), self.y + away * np.cos(self.heading)
        return np.concatenate([x, self.x]), np.concatenate([y, self.y])

    def places(self) -> tuple[Floats, Floats]:
        """Return x and y of all points: cross-sections, reference line, `AHEAD_M` before and after it."""
        ahead, left = np.cos(self.heading), np.sin(self.heading)
        x = [(self.x[:, None] - self.t * left[:, None]).ravel()]
        y = [(self.y[:, None] + self.t * ahead[:, None]).ravel()]
        for away in (0.0, -AHEAD_M, AHEAD_M):
            x.append(self.x + away * ahead)
            y.append(self.y + away * left)
        return np.concatenate(x), np.concatenate(y)


def frame(source: Path) -> Frame:
    """Return the coordinate system of a file: its ``geoReference`` and ``offset``."""
    for part in xml_text.elements(source, {"header", "road"}):
        if part.element.tag == "road":
            break
        text = " ".join((part.element.findtext("geoReference") or "").split())
        offset = part.element.find("offset")
        try:
            moved = [0.0] * 4 if offset is None else numbers(offset, *"xyz", "hdg", missing=0.0)
        except TaskError as error:
            raise TaskError(f"{error}; correct its header") from error
        return Frame(text or None, *moved)
    return Frame(None)


def lift(source: Path, out: Path, heights: HeightsAt, options: Options) -> Iterator[Lifted]:
    """Copy a file with heights; yield the rows of the report."""
    of_links = _Linked(source, heights)
    with xml_text.opened(source) as file, xml_text.written(out) as copy:
        parts = map(_read, xml_text.parts(file, {"road"}))
        for part, found in with_heights(
            parts, lambda each: each.places() if isinstance(each, Road) else NO_POINTS, heights
        ):
            text, row = _lifted(part, found, options, of_links) if isinstance(part, Road) else part
            copy.write(text)
            if row is not None:
                yield row


def _read(part: bytes | Part) -> Road | tuple[bytes, Lifted | None]:
    """Return a road or an unchanged text; for a road that cannot be read also a row with the reason."""
    if isinstance(part, bytes):
        return part, None
    name = part.element.get("id", "")
    if part.path != ("OpenDRIVE",):
        return part.text, None
    try:
        with np.errstate(all="ignore"):
            return _road(part, name)
    except TaskError as error:
        return part.text, Lifted(name, note=f"{error}; it stays as it was")


def _road(part: Part, name: str) -> Road:
    element = part.element
    (length,) = numbers(element, "length")
    if not 0 < length <= LONGEST_M:
        raise TaskError(f"has a length of {length:g} m")
    plan = plan_view.read(element)
    count = max(int(np.ceil(length / ALONG_M)), LEAST_ALONG)
    s = np.linspace(0.0, length, count + 1)
    extent = plan_view.extent(element, s)
    reach = max(float(np.abs(extent.right).max()), float(np.abs(extent.left).max()))
    # In narrow bends the outer lanes are long. Kinks between geometries are not bends.
    kept = np.diff(np.searchsorted(plan.start[:, 0], s, side="right")) == 0
    turned = float(np.abs(np.diff(plan.at(s)[2]))[kept].max(initial=0.0)) * reach
    if np.isfinite(turned) and turned > ALONG_M:
        finer = int(min(np.ceil(turned / ALONG_M), MOST_FINER, max(1, MOST_FINE // count)))
        s = np.linspace(0.0, length, count * finer + 1)
        extent = plan_view.extent(element, s)
    x, y, heading = plan.at(s)
    if not np.isfinite([x, y, heading]).all():
        raise TaskError("has a planView with places that are not numbers")
    right, left = float(extent.right.min()), float(extent.left.max())
    if left - right < ACROSS_M / 2:
        right, left = right - ACROSS_M / 2, left + ACROSS_M / 2
    across = int(np.clip(np.ceil((left - right) / ACROSS_M), LEAST_ACROSS, MOST_ACROSS))
    return Road(
        part=part,
        id=name,
        s=s,
        t=np.linspace(right, left, across + 1),
        x=x,
        y=y,
        heading=heading,
        extent=extent,
        elevation=_old(element, "elevationProfile/elevation"),
        superelevation=_old(element, "lateralProfile/superelevation"),
        structures=tuple(_structures(element)),
    )


def _structures(road: ET.Element) -> Iterator[Structure]:
    kinds: tuple[Literal["bridge", "tunnel"], ...] = ("bridge", "tunnel")
    for kind in kinds:
        for each in road.iterfind(f"objects/{kind}"):
            start, length = numbers(each, "s", "length")
            yield kind, start, start + length


def _old(road: ET.Element, path: str) -> Floats:
    """Return the pieces of a road's old profile; readers take 0 before the first piece."""
    pieces = plan_view.records(road.findall(path))
    if not len(pieces):
        return NONE
    pieces = pieces[np.argsort(pieces[:, 0], kind="stable")]
    return pieces if pieces[0, 0] <= 0 else np.vstack([NONE, pieces])


def _lifted(road: Road, heights: Heights, options: Options, of_links: _Linked) -> tuple[bytes, Lifted]:
    """Return the text of a road with heights, and its row."""
    sections, used, unknown_m, rows = _sections(road, heights, of_links)
    flat, tolerance, ends = options.beyond == "flat", options.tolerance_m, NOWHERE
    if flat and not np.isfinite(sections.line).all():
        ends = of_links.network.ends(road.nodes, beyond=True)
    elevation = road_profiles.profile(
        sections, sections.line, sections.grade, road.elevation, flat, tolerance, ends
    )
    across = road_profiles.superelevation(sections, road.superelevation, flat, tolerance)
    if elevation is None or across is None:
        text, length = road.part.text, float(road.s[-1])
        if np.isfinite(ends).any():
            at = np.array([0.0, length])
            level = cubic_pieces(at, filled(at, np.full(2, np.nan), ends), np.zeros(2), tolerance)
            text = road_profiles.with_profiles(road.part, road_profiles.texts("elevation", level), None)
        return text, Lifted(road.id, length, length, (), unknown_m)
    lateral = None if options.lateral == "none" else road_profiles.texts("superelevation", across)
    text = road_profiles.with_profiles(road.part, road_profiles.texts("elevation", elevation), lateral)
    row = _row(road, sections, used, unknown_m, elevation, across, options)
    on_lanes = np.flatnonzero(road.inside)
    numbers = np.array(heights.numbers, np.int8)[np.repeat(rows, len(road.t))[on_lanes]]
    if road.id in of_links.guessed:
        row = replace(row, note=GUESSED)
    return text, replace(row, flags=passed(heights[on_lanes].flags_on(numbers)))


def _sections(
    road: Road, heights: Heights, of_links: _Linked
) -> tuple[CrossSections, Numbers, float, NDArray[np.intp]]:
    """Return the cross-sections, their levels, the length of unknown levels (m), the rows of `Heights.z`."""
    n, m = len(road.s), len(road.t)
    line = heights[np.arange(n) * m + road.column]
    wanted, joined, unknown_m = _wanted(road, line)
    if (wanted == ANY).all() and len(complete(line)) > 1:
        wanted[:] = of_links.network.levels.get(road.id, int(ANY))
    _, chosen = along(line, wanted)
    rows = np.searchsorted(np.array(heights.numbers), chosen)
    of_point = np.concatenate([np.repeat(rows, m), *[rows] * 3])
    z = heights.z[of_point, np.arange(len(of_point))]
    on, before, after = z[n * m :].reshape(3, n)
    grid = z[: n * m].reshape(n, m)
    sections = road_profiles.cross_sections(road.s, road.t, grid, (on, before, after), road.inside, joined)
    return sections, chosen[np.isfinite(sections.line)], unknown_m, rows


def _wanted(road: Road, line: Heights) -> tuple[Numbers, Bools, float]:
    """Return the wanted levels, the places in tunnels of unknown level, the length of unknown levels (m)."""
    wanted, joined, unknown_m = np.full(len(road.s), ANY), np.zeros(len(road.s), np.bool_), 0.0
    for kind, start, end in road.structures:
        here = (road.s >= start) & (road.s <= end)
        side = 1 if kind == "bridge" else -1
        own = levels_of(line[here], side)
        if len(own) == 1:
            wanted[here] = own[0]
        elif not own:
            wanted[here] = 0
            joined |= here & (kind == "tunnel")
            unknown_m += max(0.0, min(end, float(road.s[-1])) - max(start, 0.0))
    return wanted, joined, unknown_m


class _Linked:
    """The roads of a file as a network, for levels and heights that depend on other roads.

    The file is read for it when a road first needs it.
    """

    def __init__(self, source: Path, heights: HeightsAt) -> None:
        self._source, self._heights = source, heights
        self.guessed = set[str]()

    @cached_property
    def network(self) -> Network:
        """The solved network."""
        network = Network(guessed=self.guessed)
        roads = map(_read, xml_text.elements(self._source, {"road"}))
        lines = (road for road in roads if isinstance(road, Road))
        for road, found in with_heights(lines, Road.middle_and_line, self._heights):
            middle, line = found[: len(road.s)], found[len(road.s) :]
            wanted, joined, _ = _wanted(road, middle)
            network.note(road.id, road.nodes, middle, wanted)
            z = of_levels(line, along(middle, wanted)[1])
            network.note_open(road.nodes, road.s, np.where(joined, np.nan, z))
            for own, other in road.links:
                network.join(own, other)
        network.decide()
        return network


def _row(
    road: Road,
    sections: CrossSections,
    used: Numbers,
    unknown_m: float,
    elevation: Floats,
    across: Floats,
    options: Options,
) -> Lifted:
    s, t = road.s, road.t
    known = np.isfinite(sections.line)
    seen = sections.inside & known[:, None] & np.isfinite(sections.z)
    # Lanes with ``level`` have the height of the middle.
    t_read = np.broadcast_to(road.extent.middle[:, None] if road.extent.level else t, seen.shape)

    def missed(profile: Floats, lateral: Floats) -> float:
        z = Profiles(profile, lateral).at(s[:, None], t_read)
        return float(np.abs(z - sections.z)[seen].max(initial=0.0))

    lateral = road.superelevation if options.lateral == "none" else across
    crossfall = np.where(known, np.tan(value_at(across, s)), 0.0)
    grade = np.where(known, sections.grade, 0.0)
    gone = ~(known[:-1] & known[1:]) & ~(sections.joined[:-1] | sections.joined[1:])
    return Lifted(
        id=road.id,
        length_m=float(s[-1]),
        without_ground_m=float(np.diff(s)[gone].sum()),
        levels=tuple(sorted({int(number) for number in used})),
        unknown_deck_m=unknown_m,
        before_m=missed(road.elevation, road.superelevation),
        elevation_m=missed(elevation, NONE),
        superelevation_m=np.nan if lateral is NONE else missed(elevation, lateral),
        grade=float(np.abs(grade).max()),
        crossfall=float(np.abs(crossfall).max()),
        steep=(
            *steepest("grade", np.abs(grade), options.grade_limit, road.x, road.y),
            *steepest("crossfall", np.abs(crossfall), options.crossfall_limit, road.x, road.y),
        ),
        note=ALL_LEVEL if road.extent.level and options.lateral != "none" else "",
    )
