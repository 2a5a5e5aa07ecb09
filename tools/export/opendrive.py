"""Roads as OpenDRIVE 1.8: reference lines, profiles and lanes for driving simulators, beside OpenCRG.

Roads have no links and no junctions. A road has its plan as paramPoly3, elevation and superelevation, lanes
of the known width, and a reference to its OpenCRG file. That file has the surface itself.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from typing import TYPE_CHECKING, BinaryIO
from xml.etree import ElementTree as ET
from xml.sax.saxutils import quoteattr

import numpy as np

from flexroad.catalog.grid import Bounds
from flexroad.catalog.text import printable
from flexroad.tasks.levels.along_route import Structure
from flexroad.tasks.types import Floats
from flexroad.tools.export.profiles import Profiles
from flexroad.tools.export.reference_line import ReferenceLine

if TYPE_CHECKING:
    from scipy.interpolate import PPoly

VERSION = 3
NAME = ".xodr"

# CARLA and esmini do not read <offset>: x and y are in the projection.
HEADER = """\
<?xml version="1.0" encoding="UTF-8"?>
<OpenDRIVE>
  <header revMajor="1" revMinor="8" name={name} version="1" vendor="FlexRoad" \
west="{west!r}" south="{south!r}" east="{east!r}" north="{north!r}">
    <geoReference><![CDATA[{proj}]]></geoReference>
  </header>
"""
FOOTER = "</OpenDRIVE>\n"
NARROWEST_M, WIDEST_M = 2.0, 6.0
"""Least and largest width of a lane (m). They give the number of lanes of a road if it is unknown."""
USUAL_M = 4.5
"""Largest width of the lanes of a road that is divided into more lanes (m)."""
# CARLA's parser raises an error for a lane without a mark.
NO_MARK = {"sOffset": "0.0", "type": "none", "weight": "standard", "color": "white", "laneChange": "none"}
SAME_SLOPE = 1e-9
"""Pieces whose slopes of the width differ by less become one piece."""


def encode(
    name: str,
    line: ReferenceLine,
    profiles: Profiles,
    crg: str | None = None,
    structures: Sequence[Structure] = (),
    left_hand: bool = False,
) -> bytes:
    """Return a road as XML, for `write`.

    - `crg`: name of the line's OpenCRG file, relative to the OpenDRIVE file; None without such a file.
    """
    ends, lengths = line.pieces
    element = ET.Element("road", _attributes(name=printable(line.name), length=lengths[-1], id=name))
    element.set("junction", "-1")
    element.set("rule", "LHT" if left_hand else "RHT")
    plan = ET.SubElement(element, "planView")
    for piece in zip(ends[:-1], ends[1:], lengths[:-1], lengths[1:], strict=True):
        plan.append(_geometry(line.curve, *map(float, piece)))
    elevation, lateral = ET.SubElement(element, "elevationProfile"), ET.SubElement(element, "lateralProfile")
    for parent, tag, pieces in (
        (elevation, "elevation", profiles.elevation),
        (lateral, "superelevation", profiles.superelevation),
    ):
        for piece in pieces:
            ET.SubElement(parent, tag, _attributes(**dict(zip("sabcd", piece, strict=True))))
    element.append(_lanes(line, left_hand))
    if structures:
        element.append(_objects(name, structures))
    if crg is not None:
        ET.SubElement(ET.SubElement(element, "surface"), "CRG", crg_reference(line, crg, lengths[-1]))
    ET.indent(element, level=1)
    text: bytes = ET.tostring(element, "utf-8")
    return b"  " + text + b"\n"


def write(file: BinaryIO, roads: Iterable[bytes], proj: str, bounds: Bounds, name: str = "") -> None:
    """Write roads to a file.

    - `roads`: results of `encode` with different ids.
    - `proj`: the roads' coordinate system as a PROJ string (`tools.export.georeference.LocalFrame.proj`).
    - `bounds`: west, south, east and north of the roads (m, in that system).
    """
    west, south, east, north = map(float, bounds)
    quoted = quoteattr(printable(name))
    header = HEADER.format(name=quoted, proj=proj, west=west, south=south, east=east, north=north)
    file.write(header.encode())
    for road in roads:
        file.write(road)
    file.write(FOOTER.encode())


def lane_count(line: ReferenceLine) -> int:
    """Return the number of lanes: the known number, else two, or one if the road is one-way.

    More lanes are assumed if these were wider than `WIDEST_M`. One lane for both directions is assumed if
    they were narrower than `NARROWEST_M`.
    """
    if line.lanes:
        return line.lanes
    sides, width = 1 if line.oneway else 2, float(np.median(line.width))
    if width / sides > WIDEST_M:
        return sides * math.ceil(width / sides / USUAL_M)
    return sides if width / sides >= NARROWEST_M else 1


def _objects(road: str, structures: Sequence[Structure]) -> ET.Element:
    """Return the bridges and tunnels; the schema needs tunnels first, and a material of bridges."""
    objects = ET.Element("objects")
    for number, part in sorted(enumerate(structures, 1), key=lambda each: each[1].level > 0):
        kind = ("bridge", "concrete") if part.level > 0 else ("tunnel", "standard")
        places = _attributes(s=part.start, length=part.end - part.start)
        ET.SubElement(objects, kind[0], {"id": f"{road}_{number}", "type": kind[1], **places})
    return objects


def _geometry(curve: PPoly, start: float, end: float, s: float, s_end: float) -> ET.Element:
    """Return a piece of the plan: cubics over 0 to 1, in axes at its start and along its heading."""
    step = end - start
    derivatives = np.array([curve(start, order) * step**order / math.factorial(order) for order in range(4)])
    (x, y), ahead = derivatives[0], derivatives[1]
    heading = math.atan2(ahead[1], ahead[0])
    along = derivatives @ (math.cos(heading), math.sin(heading))
    left = derivatives @ (-math.sin(heading), math.cos(heading))
    geometry = ET.Element("geometry", _attributes(s=s, x=x, y=y, hdg=heading, length=s_end - s))
    # The curve starts at the origin of these axes, along the first axis.
    u = _attributes(aU=0.0, bU=along[1], cU=along[2], dU=along[3])
    v = _attributes(aV=0.0, bV=0.0, cV=left[2], dV=left[3])
    ET.SubElement(geometry, "paramPoly3", {**u, **v, "pRange": "normalized"})
    return geometry


def _lanes(line: ReferenceLine, left_hand: bool) -> ET.Element:
    """Return the lanes, all of equal width, with the middle of the carriageway on the line.

    A road of several lanes in two directions has half of them on either side. A one-way road, and a road with
    one lane for both directions, has its lanes on the side where traffic goes along the line.
    """
    count = lane_count(line)
    one_sided = line.oneway or count == 1
    left = (count if left_hand else 0) if one_sided else count // 2
    right = count - left
    lanes = ET.Element("lanes")
    if left != right:
        # Lanes start at the line; the offset brings the outer borders to equal distances from it.
        shift = (right - left) / count / 2
        for s, a, b in _linear(line, shift):
            ET.SubElement(lanes, "laneOffset", _attributes(s=s, a=a, b=b, c=0.0, d=0.0))
    section = ET.SubElement(lanes, "laneSection", _attributes(s=0.0))
    both = {"direction": "both"} if count == 1 and not line.oneway else {}
    sides = {"left": range(left, 0, -1), "center": range(1), "right": range(-1, -right - 1, -1)}
    for side, numbers in sides.items():
        group = ET.SubElement(section, side) if numbers else None
        for number in numbers:
            kind = {"id": str(number), "type": "driving" if number else "none", "level": "false"}
            assert group is not None
            lane = ET.SubElement(group, "lane", {**kind, **(both if number else {})})
            for s, a, b in _linear(line, 1 / count) if number else ():
                ET.SubElement(lane, "width", _attributes(sOffset=s, a=a, b=b, c=0.0, d=0.0))
            ET.SubElement(lane, "roadMark", NO_MARK)
    return lanes


def _linear(line: ReferenceLine, factor: float) -> Iterator[tuple[float, float, float]]:
    """Return s, value and slope of the linear pieces of the width, multiplied by a factor."""
    value: Floats = factor * line.width
    slope = np.diff(value) / np.diff(line.s)
    begins = np.concatenate([[True], np.abs(np.diff(slope)) > SAME_SLOPE])
    for k in np.flatnonzero(begins):
        yield float(line.s[k]), float(value[k]), float(slope[k])


def crg_reference(line: ReferenceLine, file: str, length: float) -> dict[str, str]:
    """Return the attributes of a reference to OpenCRG.

    In the mode genuine, readers move the start of the file's line to the start of the road. They turn it by
    the road's heading there plus ``hOffset``. The line starts along its first chord, the road along its
    tangent. With their difference as ``hOffset`` the line stays in its place. Its heights are absolute.
    """
    turned = float(line.chord_headings[0] - line.heading[0])
    offset = math.remainder(turned, 2 * math.pi)
    kind = {"file": file, "orientation": "same", "mode": "genuine", "purpose": "elevation"}
    places = _attributes(sStart=0.0, sEnd=length, sOffset=0.0, tOffset=0.0, zOffset=0.0, hOffset=offset)
    return {**kind, **places}


def _attributes(**values: float | str) -> dict[str, str]:
    """Return attributes of XML, with all digits of numbers."""
    return {key: value if isinstance(value, str) else repr(float(value)) for key, value in values.items()}
