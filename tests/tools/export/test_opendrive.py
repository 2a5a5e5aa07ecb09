import io
import itertools
import re
from dataclasses import replace
from math import cos, sin
from xml.etree import ElementTree as ET

import numpy as np
import pytest

from flexroad.tasks.levels.along_route import Structure
from flexroad.tasks.roads.routes import CentreLine, Route
from flexroad.tools.export import opendrive
from flexroad.tools.export.profiles import NONE, HeightAt, Profiles, height_grid, profile_error, profiles
from flexroad.tools.export.reference_line import ReferenceLine, reference_line
from tests.read_opendrive import numbers, plan, polynomial, quality_issues

PROJ = "+proj=tmerc +lat_0=50.7 +lon_0=7.1 +k=1 +x_0=0 +y_0=0 +ellps=GRS80 +units=m"
BENDS = np.array([[20.0, 30.0], [70.0, 60.0], [120.0, 70.0], [150.0, 120.0], [150.0, 180.0], [120.0, 225.0]])
TURN = np.radians(np.arange(0.0, 301.0, 4.0))
LOOP = 12 * np.stack([np.sin(TURN), np.cos(TURN)], axis=1)


def hills(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return 150 + 0.02 * x + 0.8 * np.sin(x / 17) * np.cos(y / 23)


def reference(points: np.ndarray = BENDS, **known: object) -> ReferenceLine:
    parts = (CentreLine(points, 6.0, **known),)
    line = reference_line(Route(parts))
    assert line is not None
    return line


def road(line: ReferenceLine, height: HeightAt = hills, name: str = "1", crg: str | None = None) -> tuple:
    return name, line, profiles(height_grid(line, height)), crg


def written(*roads: tuple, left_hand: bool = False, **options: object) -> bytes:
    file = io.BytesIO()
    encoded = (opendrive.encode(*road, left_hand=left_hand) for road in roads)
    opendrive.write(file, encoded, PROJ, (-100.0, -50.0, 300.0, 400.0), **options)
    return file.getvalue()


def only(*roads: tuple, **options: object) -> ET.Element:
    element = ET.fromstring(written(*roads, **options)).find("road")
    assert element is not None
    return element


@pytest.mark.parametrize("points", [BENDS, LOOP], ids=["bends", "loop"])
def test_write_plan_is_within_1_mm_of_the_reference_line(points):
    line = reference(points)
    element = only(road(line))
    places = np.array([plan(element, s)[:2] for s in line.s])
    assert np.linalg.norm(places - np.stack([line.x, line.y], axis=1), axis=1).max() < 0.001
    assert float(element.attrib["length"]) == pytest.approx(line.s[-1], abs=1e-6)
    # Only where the road bends are there more pieces than one every 4 m.
    assert len(element.findall("planView/geometry")) < line.s[-1]


@pytest.mark.parametrize("points", [BENDS, LOOP], ids=["bends", "loop"])
def test_write_pieces_of_the_plan_meet_with_the_same_heading(points):
    element = only(road(reference(points).part(7, 58)))
    geometries = element.findall("planView/geometry")
    for before, after in itertools.pairwise(geometries):
        s, length = numbers(before, "s", "length")
        assert s + length == pytest.approx(float(after.attrib["s"]), abs=1e-9)
        x, y, heading = plan(element, s + length - 1e-10)
        np.testing.assert_allclose((x, y), numbers(after, "x", "y"), atol=1e-6)
        turned = (heading - float(after.attrib["hdg"]) + np.pi) % (2 * np.pi) - np.pi
        assert abs(turned) < 1e-6
        # The length is the curve's.
        fine = np.array([plan(element, at)[:2] for at in np.linspace(s, s + length - 1e-10, 201)])
        assert np.linalg.norm(np.diff(fine, axis=0), axis=1).sum() == pytest.approx(length, abs=1e-5)


def test_write_heights_miss_the_surface_as_reported():
    line = reference()
    grid = height_grid(line, hills)
    element = only(road(line))
    worst = 0.0
    for s in line.s:
        x, y, heading = plan(element, s)
        slope = np.tan(polynomial(element, "lateralProfile/superelevation", s))
        for t in (-3.0, -1.0, 0.0, 2.0, 3.0):
            z = polynomial(element, "elevationProfile/elevation", s) + t * slope
            worst = max(worst, abs(z - hills(x - t * sin(heading), y + t * cos(heading))))
    mean_m, max_m = profile_error(grid, profiles(grid))
    assert worst == pytest.approx(max_m, rel=0.1)
    assert mean_m < max_m < 0.05


def test_elevation_error_is_that_of_a_level_cross_section():
    """A plane with a crossfall of 4% on a road of 6 m: at the edges 0.12 m, on average about half of that."""
    line = reference(np.array([[0.0, 0.0], [60.0, 0.0]]))
    grid = height_grid(line, lambda x, y: 150 + 0.02 * x + 0.04 * y)
    fitted = profiles(grid)
    mean_m, max_m = profile_error(grid, Profiles(fitted.elevation, NONE))
    assert max_m == pytest.approx(0.12, abs=1e-6)
    level = np.abs(0.04 * grid.v[np.abs(grid.v) <= 3.0 + 1e-6])
    assert mean_m == pytest.approx(level.mean(), abs=1e-6)
    assert profile_error(grid, fitted)[1] < 1e-6


@pytest.mark.parametrize(
    ("known", "left_hand", "left", "right"),
    [
        ({}, False, 1, 1),
        ({"lanes": 4}, True, 2, 2),
        ({"lanes": 3}, False, 1, 2),
        ({"lanes": 2, "oneway": True}, False, 0, 2),
        ({"lanes": 2, "oneway": True}, True, 2, 0),
        ({"lanes": 1}, False, 0, 1),
        ({"lanes": 1, "oneway": True}, False, 0, 1),
        ({"oneway": True}, False, 0, 1),
    ],
)
def test_write_lanes_fill_the_carriageway_around_the_line(known, left_hand, left, right):
    element = only(road(reference(**known)), left_hand=left_hand)
    assert element.attrib["rule"] == ("LHT" if left_hand else "RHT")
    lanes = {side: element.findall(f"lanes/laneSection/{side}/lane") for side in ("left", "right")}
    assert [int(lane.attrib["id"]) for lane in lanes["left"]] == list(range(left, 0, -1))
    assert [int(lane.attrib["id"]) for lane in lanes["right"]] == list(range(-1, -right - 1, -1))
    for s in (0.0, 100.0):
        shifted = element.find("lanes/laneOffset") is not None
        offset = polynomial(element, "lanes/laneOffset", s) if shifted else 0.0
        widths = {
            side: sum(polynomial(lane, "width", s, "sOffset") for lane in lanes[side]) for side in lanes
        }
        assert offset + widths["left"] == pytest.approx(3.0)
        assert offset - widths["right"] == pytest.approx(-3.0)
    for lane in lanes["left"] + lanes["right"]:
        assert lane.get("direction") == ("both" if known == {"lanes": 1} else None)
    # CARLA's parser raises an error for a lane without a mark after its width.
    for lane in element.findall("lanes/laneSection/*/lane"):
        assert [mark.attrib["type"] for mark in lane.findall("roadMark")] == ["none"]
        assert lane[-1].tag == "roadMark"


@pytest.mark.parametrize(
    ("width", "oneway", "left", "right", "lane_m"),
    [
        (18.0, False, 2, 2, 4.5),
        (12.0, False, 1, 1, 6.0),
        (14.0, False, 2, 2, 3.5),
        (9.0, True, 0, 2, 4.5),
        (3.5, False, 0, 1, 3.5),
        (4.0, False, 1, 1, 2.0),
    ],
)
def test_write_lanes_of_unknown_number_have_a_usual_width(width, oneway, left, right, lane_m):
    line = reference(oneway=oneway)
    line = replace(line, width=np.full(len(line.s), width))
    lanes = {side: only(road(line)).findall(f"lanes/laneSection/{side}/lane") for side in ("left", "right")}
    assert (len(lanes["left"]), len(lanes["right"])) == (left, right)
    for lane in lanes["left"] + lanes["right"]:
        assert polynomial(lane, "width", 50.0, "sOffset") == pytest.approx(lane_m)
        assert lane.get("direction") == ("both" if (width, oneway) == (3.5, False) else None)


def test_write_width_follows_the_road():
    line = reference()
    line = replace(line, width=np.interp(line.s, [0, 100, 120, 300], [6, 6, 9, 9]), lanes=3)
    element = only(road(line))
    lane = element.find("lanes/laneSection/right/lane")
    assert lane is not None
    assert len(lane.findall("width")) < 10
    for s, width in zip(line.s, line.width, strict=True):
        assert polynomial(lane, "width", s, "sOffset") == pytest.approx(width / 3)
        assert polynomial(element, "lanes/laneOffset", s) == pytest.approx(width / 6)


def test_write_crg_stays_where_it_is_in_the_mode_genuine():
    line = reference(LOOP)
    crg = only(road(line, crg="road_1.crg")).find("surface/CRG")
    assert crg is not None
    wanted = {"file": "road_1.crg", "orientation": "same", "mode": "genuine", "purpose": "elevation"}
    assert wanted.items() <= crg.attrib.items()
    start, end, turned = numbers(crg, "sStart", "sEnd", "hOffset")
    assert (start, end) == (0.0, pytest.approx(line.s[-1]))
    _, _, heading = plan(only(road(line)), 0.0)
    chord = np.arctan2(line.y[1] - line.y[0], line.x[1] - line.x[0])
    assert heading + turned == pytest.approx(chord, abs=1e-9)
    assert abs(turned) < 0.01


def test_write_header_has_projection_bounds_and_no_offset():
    data = written(road(reference()), name='Köln <"a">')
    header = ET.fromstring(data).find("header")
    assert header is not None
    assert (header.attrib["revMajor"], header.attrib["revMinor"]) == ("1", "8")
    assert header.attrib["name"] == 'Köln <"a">'
    assert numbers(header, "west", "south", "east", "north") == [-100, -50, 300, 400]
    assert header.findtext("geoReference") == PROJ
    assert header.find("offset") is None
    assert data == written(road(reference()), name='Köln <"a">')


def test_write_roads_are_single_and_streamed():
    asked = []

    class File(io.BytesIO):
        def write(self, data: bytes) -> int:  # type: ignore[override]
            asked.append(len(re.findall(rb"<road ", data)))
            return super().write(data)

    line = reference()
    file = File()
    roads = (opendrive.encode(*road(line, name=str(k))) for k in range(3))
    opendrive.write(file, roads, PROJ, (0.0, 0.0, 1.0, 1.0))
    assert max(asked) == 1
    roads = ET.fromstring(file.getvalue()).findall("road")
    assert [(each.attrib["id"], each.attrib["junction"], each.find("link")) for each in roads] == [
        (str(k), "-1", None) for k in range(3)
    ]


@pytest.mark.slow
def test_write_passes_the_asam_quality_checker(tmp_path):
    path = tmp_path / "roads.xodr"
    kinds = [{}, {"lanes": 1}, {"lanes": 3}, {"lanes": 2, "oneway": True}]
    lines = [reference(**known) for known in kinds] + [reference(LOOP).part(3, 50)]
    path.write_bytes(written(*(road(line, name=str(k), crg=f"{k}.crg") for k, line in enumerate(lines))))
    assert quality_issues(path) == []


def test_bridges_and_tunnels_are_objects_between_lanes_and_surface(tmp_path):
    structures = (Structure(2, 10.0, 24.5), Structure(-1, 40.0, 52.0))
    one = (*road(reference(), crg="1.crg"), structures)
    element = only(one)
    assert [child.tag for child in element][-3:] == ["lanes", "objects", "surface"]
    tunnel, bridge = element.find("objects")
    assert tunnel.attrib == {"id": "1_2", "type": "standard", "s": "40.0", "length": "12.0"}
    assert (bridge.tag, bridge.attrib["id"], *numbers(bridge, "s", "length")) == ("bridge", "1_1", 10.0, 14.5)
    file = tmp_path / "roads.xodr"
    file.write_bytes(written((*road(reference()), structures)))
    assert quality_issues(file) == []
