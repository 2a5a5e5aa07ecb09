"""The streets of a synthetic town as an extract of OpenStreetMap: docs/examples/streets.osm.

``python -m tests.make_osm FILE`` writes it. The town is that of ``flexroad catalog synthetic --tiles 9
--tile-size 200 --seed 5``. One crossing is a roundabout, one street is a dead end, one has a tag of a
bridge, and one leaves the tiles.
"""

import sys
from pathlib import Path

import numpy as np
import pyproj
import shapely

from flexroad.catalog import Grid
from flexroad.tools.synthetic.scene import CentreLine, centre_lines

SEED, SIZE_M = 5, 600
TOWN = Grid("EPSG:25832", 500_000.0, 5_600_600.0, 1.0, SIZE_M, SIZE_M)
WITHIN = shapely.box(500_020, 5_600_020, 500_580, 5_600_580)
LEAVES = shapely.box(500_560, 5_600_495, 500_720, 5_600_640)
"""Streets within these boxes are in the extract; one in the second box leaves the tiles."""
ROUND_AT, ROUND_M = (500_228.0, 5_600_437.0), 12.0
"""The crossing nearest to this place is a roundabout of this radius (m)."""
CORNERS = 16
"""Nodes of the roundabout."""
STRAIGHT_M = 0.2
"""Streets have no nodes that are nearer than this to the line without them (m)."""
SAME_M = 3.0
"""Ends of streets that are nearer than this are one node (m)."""


def write_extract(path: Path) -> None:
    """Write the extract."""
    ways = list(_ways())
    to_degrees = pyproj.Transformer.from_crs(TOWN.crs, 4326, always_xy=True)
    numbers: dict[tuple[float, float], int] = {}
    for points, _ in ways:
        for point in points:
            numbers.setdefault(point, len(numbers) + 1)
    lines = ['<?xml version="1.0" encoding="UTF-8"?>', '<osm version="0.6" generator="FlexRoad">']
    for point, number in numbers.items():
        lon, lat = to_degrees.transform(*point)
        lines.append(f'  <node id="{number}" version="1" lat="{lat:.7f}" lon="{lon:.7f}"/>')
    for number, (points, tags) in enumerate(ways, len(numbers) + 1):
        lines.append(f'  <way id="{number}" version="1">')
        lines += [f'    <nd ref="{numbers[point]}"/>' for point in points]
        lines += [f'    <tag k="{key}" v="{value}"/>' for key, value in tags.items()]
        lines.append("  </way>")
    path.write_text("\n".join([*lines, "</osm>", ""]))


def _ways():
    """Yield the nodes of each street, as places on the map (m), and its tags."""
    streets = [(part, line) for line in centre_lines(TOWN, SEED) for part in _inside(line)]
    joined = _snapped([part for part, _ in streets])
    crossings = np.array([line.coords[end] for line in joined for end in (0, -1)])
    middle = shapely.Point(crossings[np.linalg.norm(crossings - ROUND_AT, axis=1).argmin()])
    circle = middle.buffer(ROUND_M, quad_segs=CORNERS // 4)
    ring = [tuple(point) for point in np.round(np.array(circle.exterior.coords)[:-1], 2).tolist()]
    for number, (line, (_, street)) in enumerate(zip(joined, streets, strict=True), 1):
        tags = {"highway": street.highway, "name": f"Street {number}", "lanes": "2"}
        points = [tuple(point) for point in np.round(np.array(line.coords), 2).tolist()]
        if shapely.dwithin(line, middle, 0.01):
            outside = [point for point in points if not circle.buffer(0.5).contains(shapely.Point(point))]
            if shapely.Point(points[0]).distance(middle) < 1:
                outside.reverse()
            nearest = min(ring, key=lambda corner: np.hypot(*np.subtract(corner, outside[-1])))
            points = [*outside, nearest]
        if number == 7:
            tags |= {"bridge": "yes", "layer": "1"}
        yield points, tags
    yield [*ring, ring[0]], {"highway": "secondary", "junction": "roundabout", "name": "Circle"}


def _inside(line: CentreLine):
    """Yield the parts of a line that lie in the extract as a whole."""
    shape = shapely.LineString(line.points).simplify(STRAIGHT_M)
    if shapely.within(shape, WITHIN) or shapely.within(shape, LEAVES):
        yield shape


def _snapped(lines: list[shapely.LineString]) -> list[shapely.LineString]:
    """Return the lines with ends that are near to each other at one place."""
    ends = np.array([line.coords[end] for line in lines for end in (0, -1)])
    for i in range(len(ends)):
        near = np.linalg.norm(ends - ends[i], axis=1) < SAME_M
        ends[near] = ends[i]
    result = []
    for line, first, last in zip(lines, ends[::2], ends[1::2], strict=True):
        result.append(shapely.LineString([first, *line.coords[1:-1], last]))
    return result


if __name__ == "__main__":
    write_extract(Path(sys.argv[1]))
