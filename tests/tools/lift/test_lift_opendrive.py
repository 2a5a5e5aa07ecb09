"""``flexroad lift`` of OpenDRIVE: through a run, and read by other programs."""

import csv
import subprocess
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
import pytest

from flexroad.tools.lift import plan_view
from flexroad.tools.lift.plan_view import extent
from tests import validators
from tests.read_opendrive import quality_issues
from tests.tools.lift.test_opendrive import LINE, elevation, lifted, places, road, write
from tests.tools.results.test_command import SOUTH, WEST, ground, made_run
from tests.validators.opendrive import by_carla, by_sumo

UTM = "<geoReference><![CDATA[ +proj=utm +zone=32 +ellps=GRS80 +units=m +vunits=m +no_defs ]]></geoReference>"
HERE = f'<offset x="{WEST}" y="{SOUTH}" z="90" hdg="0"/>'
ROAD = road(LINE.replace('x="10" y="20"', 'x="5" y="20"'), 30.0)


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
    return made_run(tmp_path_factory.mktemp("ground"))


@pytest.mark.parametrize(
    ("header", "words"),
    [
        (UTM + HERE, []),
        (HERE, ["--crs", "EPSG:25832"]),
        ("", ["--crs", "EPSG:25832", "--offset", WEST, SOUTH]),
        ("<geoReference>EPSG:25832</geoReference>", ["--offset", WEST, SOUTH]),
        # A file that is turned by 90 degrees around its new origin.
        (UTM + f'<offset x="{WEST + 40}" y="{SOUTH + 2}" z="90" hdg="1.5707963267948966"/>', []),
    ],
)
def test_roads_get_the_heights_of_the_run(run, flexroad, tmp_path, header, words):
    source, out, report = write(tmp_path, ROAD, header=header), tmp_path / "out.xodr", tmp_path / "report.csv"
    said = flexroad("lift", source, run, "-o", out, "--report", report, *words).expected(0)
    across = 175 if "1.57" in header else 70
    assert (
        said.out == f"{out}: 1 road, 30 m; at most {across} mm, 0 mm with superelevation from the surface\n"
    )
    element = ET.parse(out).getroot().find("road")
    down = 90 if "z=" in header else 0
    turned = "1.57" in header
    for s in (0.0, 10.0, 30.0):
        x, y = (20.0, 2 + 5 + s) if turned else (5 + s, 20.0)
        z = elevation(element, s)
        assert z + down == pytest.approx(ground(WEST + x, SOUTH + y), abs=2e-3)
    (row,) = csv.DictReader(report.open())
    assert float(row["superelevation_max_mm"]) < 1
    assert float(row["grade_max_percent"]) == pytest.approx(2 if turned else 5, abs=0.01)


@pytest.mark.parametrize(
    "shape",
    [
        "<line/>",
        '<arc curvature="0.02"/>',
        '<arc curvature="-0.03"/>',
        '<spiral curvStart="0" curvEnd="0.04"/>',
        '<spiral curvStart="0.03" curvEnd="-0.03"/>',
        '<poly3 a="0" b="0" c="0.004" d="-0.00003"/>',
        '<paramPoly3 pRange="normalized" aU="0" bU="53.1981" cU="-4.076483" dU="-1.019121" aV="0" bV="0" '
        'cV="18.344172" dV="-6.114724"/>',
        '<paramPoly3 pRange="arcLength" aU="0" bU="1" cU="0" dU="-4.2e-6" aV="0" bV="0" cV="0.0025" dV="0"/>',
    ],
)
def test_carla_is_on_the_surface_at_its_own_places(tmp_path, shape):
    # A narrow lane: its middle is on the reference line, where the elevation is the surface.
    validators.python()

    def steep(x, y):
        return 100 + 0.3 * x - 0.2 * y + np.sin(x / 20)

    plan = f'<geometry s="0" x="10" y="20" hdg="0.7" length="{{length}}">{shape}</geometry>'
    lane = '<lane id="-1" type="driving" level="false"><link/><width sOffset="0" a="0.02" b="0" c="0" d="0"/>'
    mark = '<roadMark sOffset="0" type="none" weight="standard" color="standard" width="0.1"/></lane>'
    center = f'<center><lane id="0" type="none" level="false"><link/>{mark}</center>'
    lanes = f'<lanes><laneSection s="0">{center}<right>{lane}{mark}</right></laneSection></lanes>'
    lifted(write(tmp_path, road(plan, 50.0, lanes=lanes), header=UTM), steep)
    _, found = by_carla(tmp_path / "out.xodr")
    assert len(found) >= 48
    x, y, z = found.T
    assert np.abs(z - steep(x, y)).max() < 0.03


EDGES = """<edges>
  <edge id="ab" from="a" to="b" numLanes="2" sidewalkWidth="2"/><edge id="ba" from="b" to="a"/>
  <edge id="bc" from="b" to="c" shape="104,40 112,70"/><edge id="cb" from="c" to="b"/>
  <edge id="bd" from="b" to="d"/><edge id="db" from="d" to="b"/>
</edges>"""
NODES = """<nodes>
  <node id="a" x="10" y="10"/><node id="b" x="100" y="20"/><node id="c" x="110" y="100"/>
  <node id="d" x="190" y="30"/>
</nodes>"""


@pytest.fixture(scope="module")
def network(tmp_path_factory) -> Path:
    """A network by netconvert, whose lanes may be superelevated."""
    folder = tmp_path_factory.mktemp("network")
    (folder / "n.xml").write_text(NODES)
    (folder / "e.xml").write_text(EDGES)
    out = folder / "in.xodr"
    command = ["-n", folder / "n.xml", "-e", folder / "e.xml", "--opendrive-output", out]
    subprocess.run([validators.program("netconvert"), *command], check=True, capture_output=True)
    out.write_text(out.read_text().replace('level="true"', 'level="false"'))
    return out


def hilly(x, y):
    return 100 + 2 * np.sin(x / 25) + 1.5 * np.cos(y / 30)


def test_a_network_of_netconvert_lies_on_a_hilly_surface(network):
    root, rows = lifted(network, hilly)
    assert len(rows) == 18
    for element, row in zip(root.findall("road"), rows, strict=True):
        x, y, z = places(element, float(extent(element, np.zeros(1)).right[0]), 0.0).T
        assert np.abs(z - hilly(x, y)).max() < 0.02, row
        assert row.superelevation_m < 0.02


def test_linked_roads_of_netconvert_meet_within_a_millimetre(network):
    root, _ = lifted(network, hilly)
    roads = {each.get("id"): each for each in root.findall("road")}
    met = 0
    for element in roads.values():
        for kind, s in (("predecessor", 0.0), ("successor", float(element.get("length")))):
            link = element.find(f"link/{kind}")
            if link is None or link.get("elementType") != "road":
                continue
            other = roads[link.get("elementId")]
            end = float(other.get("length")) if link.get("contactPoint") == "end" else 0.0
            ends = []
            for each, at in ((element, s), (other, end)):
                x, y, heading = (float(value[0]) for value in plan_view.read(each).at(np.array([at])))
                z = elevation(each, at)
                step = 1e-4 if at == 0 else -1e-4
                grade = (elevation(each, at + step) - z) / step
                ends.append((x, y, heading, z, grade))
            (x, y, heading, z, grade), (x_2, y_2, heading_2, z_2, grade_2) = ends
            if np.hypot(x - x_2, y - y_2) > 0.01:
                # It meets another lane than the one at the reference line.
                continue
            assert abs(z - z_2) < 1e-3
            if abs(turned := np.cos(heading - heading_2)) > 0.99999:
                met += 1
                assert abs(grade - turned * grade_2) < 1e-3
    assert met >= 10


def test_other_programs_open_a_lifted_network(network, tmp_path):
    before = quality_issues(network)
    lifted(network, hilly)
    out = network.with_name("out.xodr")
    after = quality_issues(out)
    assert sorted(each["description"] for each in after) == sorted(each["description"] for each in before)
    _, on_lanes = by_carla(out)
    _, of_sumo = by_sumo(out, tmp_path)
    # Both take the elevation alone: half a lane beside the line, the crossfall is missed.
    for x, y, z in (on_lanes.T, of_sumo.T):
        assert len(z) > 50
        assert np.abs(z - hilly(x, y)).max() < 0.6
        assert np.median(np.abs(z - hilly(x, y))) < 0.1
