"""Networks of SUMO on known surfaces: heights of all shapes, levels where roads cross, and a drive."""

import re
import subprocess
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
import pytest

from flexroad.pipeline.run.sampler import Heights
from flexroad.tasks.errors import TaskError
from flexroad.tools.lift import sumo
from flexroad.tools.lift.types import Frame, Options
from tests import validators

HEAD = """<?xml version="1.0" encoding="UTF-8"?>
<!-- <edge id="c"> by netconvert -->
<net version="1.20" xmlns:xsi="http://www.w3.org/2001/XMLSchema-instance">

    <location netOffset="-500000.00,-5600000.00{z}" convBoundary="0.00,0.00,100.00,60.00"
        projParameter="{crs}"/>
    <type id="a" priority='3'/>
"""
NET = (
    HEAD.format(z="", crs="+proj=utm +zone=32 +ellps=WGS84")
    + """    <edge id=":b_0" function="internal">
        <lane id=":b_0_0" index="0" speed="9" length="20.00" shape="40.00,28.40 60.00,28.40"/>
    </edge>
    <edge id=":b_c0" function="crossing" crossingEdges="ab">
        <lane id=":b_c0_0" index="0" length="6.40" width="4.00" shape="42.00,33.20 42.00,26.80"
            outlineShape="40.00,34.00 44.00,34.00 44.00,26.00 40.00,26.00"/>
    </edge>
    <edge id=":b_w0" function="walkingarea">
        <lane id=":b_w0_0" index="0" length="2.00" shape="42.00,26.00 44.00,26.00 40.00,24.00 42.00,24.00"/>
    </edge>

    <edge id="ab" from="a" to="b" priority="-1">
        <lane id="ab_0" index="0" length="39.00" shape="-0.00,28.40 40.00,28.40"><!-- kept --></lane>
        <lane id="ab_1" index="1" speed='13.89' length="39.00" shape='0.00,31.60 40.00,31.60'>
            <param key="origId" value="&quot;1&quot;"/>
        </lane>
    </edge>
    <edge id="bc" from="b" to="c" shape="50.00,30.00 80.00,45.00 100.00,30.00">
        <lane id="bc_0" index="0" length="45.00" shape="60.00,28.40 80.00,42.00 95.00,30.00"/>
    </edge>

    <junction id="a" type="dead_end" x="0.00" y="30.00" incLanes="" shape="0.00,27.00 0.00,33.00"/>
    <junction id="b" type="priority" x="50.00" y="30.00" incLanes="ab_0 ab_1" intLanes=":b_0_0"
        shape="40.00,24.00 40.00,34.00 60.00,34.00 60.00,24.00" customShape="1">
        <request index="0" response="0" foes="0" cont="0"/>
    </junction>
    <junction id="c" type="dead_end" x="100.00" y="30.00" incLanes="bc_0" shape="95.00,27.00 95.00,33.00"/>
    <connection from="ab" to="bc" fromLane="0" toLane="0" via=":b_0_0" dir="s" state="M"/>
    <mine a="1"><edge shape="1,2"/></mine>
</net>
"""
)
SHAPE = re.compile(r"""\s(\w*[sS]hape)=["']([-\d][^"']*,[^"']*)["']""")
NUMBER = r"-?\d+(?:\.\d+)?"
THIRD = f"({NUMBER},{NUMBER}),{NUMBER}"


def plane(x, y):
    return 100 + 0.05 * np.asarray(x) - 0.02 * np.asarray(y)


def hills(x, y):
    return 100 + 1.5 * np.sin(np.asarray(x) / 9) * np.cos(np.asarray(y) / 12)


def over(surface, where=lambda x, y: x > -1e9):
    """Heights of one level, where the surface is."""
    return lambda x, y: Heights((0,), np.where(where(x, y), surface(x - 500000, y - 5600000), np.nan)[None])


def run(tmp_path: Path, heights, text: str = NET, options=Options(), name="net.net.xml"):  # noqa: B008
    """Return the copy of a network and the rows of its report by id."""
    source, out = tmp_path / name, tmp_path / f"out.{name}"
    if not source.exists():
        source.write_text(text)
    place = sumo.frame(source)

    def at(x, y):
        found = heights(x + place.x, y + place.y)
        return Heights(found.numbers, found.z - place.z)

    rows = list(sumo.lift(source, out, at, options))
    return out.read_text(), {row.id: row for row in rows}


@pytest.fixture
def lifted(tmp_path):
    return lambda *args, **more: run(tmp_path, *args, **more)


def points(text: str, among: str = "") -> np.ndarray:
    """The vertices with heights of all shapes of a network, or of the elements that begin with a text."""
    found = [
        [float(value) for value in vertex.split(",")]
        for line in text.splitlines()
        if among in line and "<mine" not in line
        for _, shape in SHAPE.findall(line)
        for vertex in shape.split()
    ]
    return np.array(found)


def flat(text: str) -> str:
    """A network without what `lift` adds to it on a plane."""
    text = SHAPE.sub(
        lambda found: f'{found[0][0]}{found[1]}="{re.sub(THIRD, lambda place: place[1], found[2])}"', text
    )
    return re.sub(rf' z="{NUMBER}"', "", text)


def test_all_shapes_of_a_plane_have_its_heights_and_all_else_stays(lifted):
    copy, rows = lifted(over(plane))
    found = points(copy)
    assert len(found) == len(points(NET))
    np.testing.assert_allclose(found[:, 2], plane(*found[:, :2].T), atol=6e-4)
    junctions = [
        [float(value) for value in each] for each in re.findall(r'x="(.*?)" y="(.*?)"[^>]* z="(.*?)"', copy)
    ]
    np.testing.assert_allclose(np.array(junctions)[:, 2], plane(*np.array(junctions)[:, :2].T), atol=6e-4)
    assert len(junctions) == 3
    assert '<mine a="1"><edge shape="1,2"/></mine>' in copy
    assert flat(copy) == NET.replace("'0.00,31.60 40.00,31.60'", '"0.00,31.60 40.00,31.60"')
    row = rows["ab"]
    assert (row.length_m, row.without_ground_m, row.levels) == (40, 0, (0,))
    assert row.grade == pytest.approx(0.05)
    assert np.isnan(row.before_m)
    assert list(rows) == ["ab", "bc"]


def test_lines_get_vertices_and_stay_within_the_tolerance(lifted):
    copy, rows = lifted(over(hills), options=Options(tolerance_m=0.01))
    root = ET.fromstring(copy)
    for element in (*root.findall("edge/lane"), *root.findall("edge[@from]")):
        if "_w" in element.get("id"):
            continue
        x, y, z = np.array([vertex.split(",") for vertex in element.get("shape").split()], float).T
        t = np.linspace(0, len(x) - 1, 2000)
        along = [np.interp(t, np.arange(len(x)), values) for values in (x, y, z)]
        # The surface is taken every half metre.
        assert np.abs(along[2] - hills(*along[:2])).max() <= 0.0115
    assert len(points(copy, '"ab_0"')) > 10
    assert 0 < rows["ab"].elevation_m <= 0.01
    own, found = (
        {tuple(place) for place in np.round(points(text)[:, :2], 2).tolist()} for text in (NET, copy)
    )
    assert own < found


@pytest.mark.parametrize("options", [Options(), Options(tolerance_m=0.1), Options(add_vertices=False)])
def test_what_meets_in_plan_meets_in_height(lifted, options):
    copy, rows = lifted(over(hills), options=options)
    heights = {}
    for x, y, z in points(copy):
        heights.setdefault((round(x, 3), round(y, 3)), set()).add(z)
    assert {len(values) for values in heights.values()} == {1}
    if options.add_vertices is False:
        assert len(points(copy)) == len(points(NET))
        assert rows["ab"].elevation_m > 0.3


def test_an_edge_without_shape_gets_one_only_where_it_needs_vertices(lifted):
    assert 'to="b" priority="-1">' in lifted(over(plane))[0]
    copy, _ = lifted(over(hills))
    shape = re.search(r'to="b" priority="-1" shape="(.*?)">', copy)[1].split()
    assert [shape[0][:11], shape[-1][:12]] == ["0.00,30.00,", "50.00,30.00,"]


def test_heights_that_a_network_has_are_replaced_and_have_its_offset(lifted, tmp_path):
    text = NET.replace('5600000.00"', '5600000.00,-40.00"').replace(
        "60.00,28.40 80.00,42.00", "60.00,28.40,1 80.00,42.00,63.200"
    )
    copy, rows = lifted(over(plane), text)
    found = points(copy)
    np.testing.assert_allclose(found[:, 2] + 40, plane(*found[:, :2].T), atol=6e-4)
    assert rows["bc"].before_m == pytest.approx(plane(60, 28.4) - 41)
    assert sumo.frame(tmp_path / "net.net.xml") == Frame(
        "+proj=utm +zone=32 +ellps=WGS84", 500000, 5600000, 40
    )


@pytest.mark.parametrize("crs", ["!", "-", "", "."])
def test_a_network_without_projection_names_no_crs(tmp_path, crs):
    path = tmp_path / "net.xml"
    path.write_text(HEAD.format(z="", crs=crs) + "</net>")
    assert sumo.frame(path) == Frame(None, 500000, 5600000)
    path.write_text("<net/>")
    assert sumo.frame(path) == Frame(None)


@pytest.mark.parametrize("ends", [False, True])
def test_beyond_the_surface_lines_keep_what_they_had_or_go_on_level(lifted, ends):
    text = NET.replace("95.00,30.00", "95.00,30.00,7.5")
    copy, rows = lifted(
        over(plane, lambda x, y: x - 500000 <= 70), text, options=Options(beyond="flat" if ends else "keep")
    )
    shape = re.search(r'"bc_0".*shape="(.*?)"', copy)[1].split()
    x, y = np.array([vertex.split(",")[:2] for vertex in shape], float).T
    assert 69 < x[1] <= 70
    assert shape[1].endswith(f",{plane(x[1], y[1]):.3f}")
    last = shape[1].split(",")[2]
    assert shape[2:] == (
        [f"80.00,42.00,{last}", f"95.00,30.00,{last}"] if ends else ["80.00,42.00", "95.00,30.00,7.5"]
    )
    assert rows["bc"].without_ground_m == pytest.approx(np.hypot(20, 13.6) / 2 + np.hypot(15, 12), abs=0.5)
    assert rows["ab"].without_ground_m == 0
    junction = re.search(r'<junction id="c".*', copy)[0]
    assert ("z=" in junction) == ends


@pytest.mark.parametrize(
    ("before", "after", "words"),
    [
        ("60.00,28.40 80.00,42.00", "60.00,28.40 80.00", "lane 'bc_0': '60.00,28.40 80.00 95"),
        ("60.00,28.40 80.00", "60.00,x 80.00", "has coordinates that are not numbers"),
        ("-500000.00,-5600000.00", "-500000.00", "has the netOffset '-500000.00', not two or three numbers"),
        ("-500000.00,", "nan,", "has the netOffset"),
    ],
)
def test_coordinates_that_are_no_numbers_are_refused_in_one_line(lifted, before, after, words):
    with pytest.raises(TaskError, match=words) as raised:
        lifted(over(plane), NET.replace(before, after))
    assert "\n" not in str(raised.value)


def test_coordinates_that_are_nan_and_lines_of_no_length_have_no_figures(lifted):
    text = NET.replace("60.00,28.40 80.00,42.00 95.00,30.00", "nan,nan 80.00,42.00").replace(
        "-0.00,28.40 40.00,28.40", "40.00,28.40 40.00,28.40"
    )
    copy, rows = lifted(over(plane), text)
    assert 'shape="nan,nan 80.00,42.00,' in copy
    assert rows["ab"].length_m == 40
    assert np.isnan(rows["bc"].grade)


# Roads above roads: a deck from x = 40 to x = 60 of a street along y = 30, 6 m above the one along x = 50.


def crossing(x, y):
    """A rising street with a deck over a street at 94 m."""
    street = 100 + 0.02 * x
    below = (x > 40.5) & (x < 59.5)
    deck = (x >= 40) & (x <= 60) & (np.abs(y - 30) <= 5)
    return Heights((0, 1), np.stack([np.where(below, 94.0, street), np.where(deck, street, np.nan)]))


def in_run(x, y):
    """The crossing at places in the CRS of the run."""
    return crossing(x - 500000, y - 5600000)


def lane(name: str, ends: str, *shapes: str, params: str = "") -> str:
    lanes = "".join(
        f'<lane id="{name}_{i}" index="{i}" shape="{shape}"/>\n' for i, shape in enumerate(shapes)
    )
    return f'<edge id="{name}" {ends}>\n{lanes}{params}</edge>\n'


def crossing_net(**params: str) -> str:
    """The street in three edges with junctions on the deck, and a street below in two with one beneath it."""
    parts = [
        lane(":p_0", 'function="internal"', "43,30 45,30"),
        lane(":q_0", 'function="internal"', "55,30 57,30"),
        *(lane(f":u_{i}", 'function="internal"', f"50,{28 + 2 * i} 50,{30 + 2 * i}") for i in range(2)),
        lane("pq", 'from="p" to="q"', "45,30 55,30", "45,31 55,31", params=params.get("pq", "")),
        lane("ap", 'from="a" to="p"', "0,30 43,30"),
        lane("qb", 'from="q" to="b"', "57,30 100,30"),
        lane("su", 'from="s" to="u"', "50,0 50,28"),
        lane("un", 'from="u" to="n"', "50,32 50,60"),
        '<junction id="p" x="44" y="30" shape="43,27 43,36 45,36 45,27"/>\n',
        '<junction id="q" x="56" y="30" shape="55,27 55,33 57,33 57,27"/>\n',
        '<junction id="u" x="50" y="30" shape="47,28 47,32 53,32 53,28"/>\n',
        '<junction id="a" x="0" y="30" shape="0,27 0,33"/>\n',
        '<junction id="b" x="100" y="30" shape="100,27 100,33"/>\n',
        '<junction id="s" x="50" y="0" shape="47,0 53,0"/>\n',
        '<junction id="n" x="50" y="60" shape="47,60 53,60"/>\n',
    ]
    return HEAD.format(z="", crs="!") + "".join(parts) + "</net>"


BRIDGE = '<param key="bridge" value="yes"/><param key="layer" value="2"/>\n'


@pytest.mark.parametrize("params", [{}, {"pq": BRIDGE}])
def test_edges_on_a_deck_and_below_it_go_on_as_those_that_they_meet(lifted, params):
    copy, rows = lifted(in_run, crossing_net(**params))
    for name in ("ap_", "pq_", "qb_", ":p_0_0", ":q_0_0"):
        found = points(copy, f'lane id="{name}')
        np.testing.assert_allclose(found[:, 2], 100 + 0.02 * found[:, 0], atol=6e-3)
    for name in ("su_", "un_", ":u_0_0", ":u_1_0"):
        assert set(points(copy, f'lane id="{name}')[:, 2]) == {94.0}
    assert [rows[name].levels for name in ("ap", "pq", "qb", "su")] == [(0, 1), (1,), (0, 1), (0,)]
    assert {row.unknown_deck_m for row in rows.values()} == {0}
    for name, place in (("p", 100.88), ("q", 101.12), ("u", 94)):
        assert f'z="{place:.3f}"' in re.search(rf'<junction id="{name}".*', copy)[0]
        found = points(copy, f'junction id="{name}"')
        np.testing.assert_allclose(found[:, 2], 94 if name == "u" else 100 + 0.02 * found[:, 0], atol=6e-4)


def rough_deck(x, y):
    """The crossing with a deck that is rougher than the ground where both have one height."""
    found = in_run(x, y)
    return Heights((0, 1), found.z + [[0.0], [0.01]] * np.sin(3 * x))


@pytest.mark.parametrize("order", [1, -1])
def test_lanes_from_abutment_to_abutment_are_on_their_deck(lifted, order):
    edges = [
        lane("ap", 'from="a" to="p"', "0,30 40.2,30", "0,31 40.2,31"),
        lane("pq", 'from="p" to="q"', "40.2,30 59.8,30", "40.2,31 59.8,31"),
        lane("qb", 'from="q" to="b"', "59.8,30 100,30", "59.8,31 100,31"),
    ]
    copy, rows = lifted(rough_deck, HEAD.format(z="", crs="!") + "".join(edges[::order]) + "</net>")
    found = points(copy)
    np.testing.assert_allclose(found[:, 2], 100 + 0.02 * found[:, 0], atol=0.016)
    assert rows["pq"].levels in ((1,), (0, 1))
    assert {row.note for row in rows.values()} == {""}


def test_an_edge_whose_level_nothing_says_is_named(lifted):
    text = HEAD.format(z="", crs="!") + lane("pq", 'from="p" to="q"', "45,30 55,30") + "</net>"
    copy, rows = lifted(in_run, text)
    np.testing.assert_allclose(points(copy)[:, 2], [100.9, 101.1], atol=6e-4)
    assert "nothing that it meets says which" in rows["pq"].note


def test_a_bridge_without_its_level_is_told_and_a_tunnel_keeps_what_it_had(lifted):
    level = over(lambda x, y: np.full(np.shape(x), 94.0))
    _, rows = lifted(level, crossing_net(pq=BRIDGE))
    assert rows["pq"].unknown_deck_m == 10
    tunnel = '<param key="tunnel" value="yes"/>'
    text = crossing_net(pq=tunnel).replace('"45,30 55,30"', '"45,30 48,30,80 55,30"')
    copy, rows = lifted(level, text.replace("crossing", ""), name="tunnel.net.xml")
    assert 'shape="45,30,94.000 48,30,80 55,30,94.000"' in copy
    assert rows["pq"].unknown_deck_m == 10


def test_a_network_of_netconvert_is_driven_with_its_heights_and_opened_again(tmp_path):
    plain = {
        "nodes": '<nodes><node id="a" x="-60" y="10"/><node id="b" x="0" y="10"/><node id="c" x="60" y="20"/>'
        '<node id="d" x="0" y="70"/><node id="e" x="-5" y="-50"/></nodes>',
        "edges": '<edges><edge id="ab" from="a" to="b" numLanes="2"/><edge id="bc" from="b" to="c"/>'
        '<edge id="cb" from="c" to="b"/><edge id="bd" from="b" to="d" shape="0,10 5,40 0,70"/>'
        '<edge id="eb" from="e" to="b"/><edge id="dc" from="d" to="c"/><edge id="db" from="d" to="b"/>'
        '<edge id="ba" from="b" to="a"/><edge id="be" from="b" to="e"/></edges>',
        "routes": '<routes><vType id="t" sigma="0"/><vehicle id="v" type="t" depart="0">'
        '<route edges="ab bc cb bd dc cb be eb ba ab bd db ba"/></vehicle></routes>',
    }
    for name, text in plain.items():
        (tmp_path / f"{name}.xml").write_text(text)

    def call(program, *words):
        command = [validators.program(program), *words]
        return subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True).stderr

    made = ["--offset.disable-normalization", "true", "--sidewalks.guess", "--crossings.guess"]
    call(
        "netconvert",
        "-n",
        "nodes.xml",
        "-e",
        "edges.xml",
        *made,
        "--sidewalks.guess.min-speed",
        "1",
        "-o",
        "n.net.xml",
    )

    def surface(x, y):
        return 100 + 0.5 * np.sin(x / 9 + 0.5) * np.cos(y / 12)

    copy, rows = run(tmp_path, lambda x, y: Heights((0,), surface(x, y)[None]), name="n.net.xml")
    found = points(copy)
    np.testing.assert_allclose(found[:, 2], surface(*found[:, :2].T), atol=1e-3)
    assert all(vertex.count(",") == 2 for _, shape in SHAPE.findall(copy) for vertex in shape.split())
    fcd = ["--fcd-output", "fcd.xml", "--fcd-output.attributes", "x,y,z,lane", "--precision", "3"]
    said = call(
        "sumo", "-n", "out.n.net.xml", "-r", "routes.xml", *fcd, "--step-length", "0.5", "--no-step-log"
    )
    assert "Error" not in said
    seen = list(ET.parse(tmp_path / "fcd.xml").iter("vehicle"))
    x, y, z = np.array([[each.get(name) for name in "xyz"] for each in seen], float).T
    assert {each.get("lane").split("_")[0] for each in seen} >= set(rows)
    np.testing.assert_allclose(z, surface(x, y), atol=0.0065)
    call("netconvert", "-s", "out.n.net.xml", "--precision", "3", "-o", "again.net.xml")
    again = ET.parse(tmp_path / "again.net.xml").getroot()
    assert len(again.findall("edge[@shape]")) == len(rows)
    for edge in again.findall("edge[@shape]"):
        x, y, z = np.array([each.split(",") for each in edge.get("shape").split()], float).T
        np.testing.assert_allclose(z, surface(x, y), atol=0.0065)
