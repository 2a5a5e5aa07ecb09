"""OpenStreetMap's XML (``.osm``), also as Lanelet2 uses it: a tag ``ele`` at each node with a surface."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from flexroad.tasks.lift import xml_text
from flexroad.tasks.lift.batches import with_heights
from flexroad.tasks.lift.types import Frame, HeightsAt, Lifted, Options
from flexroad.tasks.lift.xml_text import Part
from flexroad.tasks.types import Floats

STEPS = False
"""Whether heights have the steps beside roads."""


def frame(source: Path) -> Frame:
    """Return where the coordinates of a file are: longitude and latitude."""
    return Frame("EPSG:4326")


def lift(source: Path, out: Path, heights: HeightsAt, options: Options) -> Iterator[Lifted]:
    """Copy a file with heights; yield the rows of the report.

    Raises
    ------
    TaskError
        If the file cannot be read; continues a sentence that begins with its name.
    """
    with xml_text.opened(source) as file, xml_text.written(out) as copy:
        for part, found in with_heights(xml_text.parts(file, {"node"}), _points, heights):
            if isinstance(part, bytes) or found is None:
                copy.write(part if isinstance(part, bytes) else part.text)
                continue
            copy.write(_with_ele(part, float(found.ground[0])))
    yield Lifted(id="")


def _points(part: bytes | Part) -> tuple[Floats, Floats] | None:
    if isinstance(part, bytes):
        return None
    lon, lat = part.element.get("lon"), part.element.get("lat")
    return np.array([float(lon or "nan")]), np.array([float(lat or "nan")])


def _with_ele(part: Part, z: float) -> bytes:
    if not np.isfinite(z):
        return part.text
    for tag in part.element.iter("tag"):
        if tag.get("k") == "ele":
            return part.replaced([part.with_attributes(tag, {"v": f"{z:.3f}"})])
    return part.replaced([part.with_child(f'<tag k="ele" v="{z:.3f}"/>')])
