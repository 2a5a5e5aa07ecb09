"""OSM and Lanelet2 files on known surfaces: heights of nodes, new nodes, and levels of ways."""

import re

import numpy as np
import pyproj
import pytest

from flexroad.pipeline.run.sampler import Heights
from flexroad.tasks.errors import TaskError
from flexroad.tools.lift import osm
from flexroad.tools.lift.types import Frame, Options
from tests.tools.lift import test_sumo
from tests.tools.lift.test_sumo import hills, plane

WEST, SOUTH = 9.0, 50.55
EAST_M, NORTH_M = (
    1000 * pyproj.Geod(ellps="WGS84").inv(WEST, SOUTH, WEST + east / 1000, SOUTH + north / 1000)[2]
    for east, north in ((1, 0), (0, 1))
)
"""Lengths of a degree there."""
OSM = """<?xml version='1.0' encoding='UTF-8'?>
<!-- a street & its path -->
<osm version="0.6" generator="hand">
  <bounds minlat="50.55" minlon="9.0" maxlat="50.56" maxlon="9.01"/>
  <node id="1" lat="50.5500000" lon="9.0000000" version="2"/>
  <node id="2" lat="50.5500000" lon="9.0010000"><tag k="highway" v='crossing'/></node>
  <node id='3' lat='50.5505000' lon='9.0010000'>
    <tag k='local_x' v='12.5'/><tag k='ele' v='90' /><tag k="name" v="&lt;ele&gt;"/>
  </node>
  <node id="4" visible="false"/>
  <node id="5" lat="50.5505000" lon="9.0010000" action="delete"/>
  <node id="-6" lat="50.5502000" lon="9.0003000"><tag k="natural" v="tree"/></node>
  <way id="10"><nd ref="1"/><nd ref="2"/><nd ref="3"/><tag k="highway" v="residential"/></way>
  <way id="11">
    <nd ref="3"/>
    <nd ref="2"/>
    <nd ref="-6"/>
    <nd ref="77"/>
    <tag k="landuse" v="forest"/>
  </way>
  <relation id="12"><member type="way" ref="10" role=""/><tag k="ele" v="1"/></relation>
</osm>
"""


def metres(x, y):
    return (np.asarray(x) - WEST) * EAST_M, (np.asarray(y) - SOUTH) * NORTH_M


def over(surface, where=lambda x, y: x > -1e9):
    """Heights of one level in metres from the corner, where the surface is."""

    def heights(x, y):
        x, y = metres(x, y)
        return Heights((0,), np.where(where(x, y), surface(x, y), np.nan)[None])

    return heights


@pytest.fixture
def lifted(tmp_path):
    """The copy of a file, and the rows of its report by id."""

    def call(heights, text=OSM, options=Options()):  # noqa: B008
        source, out = tmp_path / "a.osm", tmp_path / "b.osm"
        source.write_text(text)
        rows = list(osm.lift(source, out, heights, options))
        return out.read_text(), {row.id: row for row in rows}

    return call


def nodes(text: str) -> dict[int, tuple[float, float, float]]:
    """Longitude, latitude and height of each node with a height."""
    found = {}
    for node in re.finditer(r"<node[^>]*?(/>|>.*?</node>)", text, re.DOTALL):
        values = [re.search(rf"\b{name}=[\"'](.*?)[\"']", node[0]) for name in ("id", "lon", "lat")]
        ele = re.search(r"k=[\"']ele[\"'] v=[\"'](.*?)[\"']", node[0])
        if ele and all(values):
            found[int(values[0][1])] = (float(values[1][1]), float(values[2][1]), float(ele[1]))
    return found


def refs(text: str, way: int) -> list[int]:
    return [
        int(ref)
        for ref in re.findall(r'nd ref="(.*?)"', re.search(rf'<way id="{way}".*?</way>', text, re.DOTALL)[0])
    ]


def assert_heights(text: str, surface, atol=6e-4) -> None:
    for x, y, z in nodes(text).values():
        assert z == pytest.approx(float(surface(*metres(x, y))), abs=atol)


def test_nodes_get_the_height_of_the_plane_and_all_else_stays(lifted):
    copy, rows = lifted(over(plane))
    assert set(nodes(copy)) == {1, 2, 3, -6}
    assert_heights(copy, plane)
    before = re.sub(r'(?<!/>)<tag k="ele" v="[\d.]+"/></node>', "</node>", copy)
    before = re.sub(r"(<node[^>]*)></node>", r"\1/>", before)
    before = re.sub(r'(<tag k="(?:highway|natural)" v=.\w+./>)<tag k="ele" v="[\d.]+"/>', r"\1", before)
    before = re.sub(r"""<tag k='ele' v="[\d.]+" />""", "<tag k='ele' v='90' />", before)
    assert before == OSM
    row = rows["10"]
    assert list(rows) == ["10"]
    assert row.length_m == pytest.approx(0.001 * EAST_M + 0.0005 * NORTH_M, rel=3e-4)
    assert row.grade == pytest.approx(0.05, rel=1e-3)
    assert row.before_m == pytest.approx(float(plane(*metres(9.001, 50.5505))) - 90, abs=1e-6)
    assert (row.without_ground_m, row.unknown_deck_m, row.levels) == (0, 0, (0,))


def test_nodes_are_added_where_asked_to_all_ways_of_a_segment(lifted):
    plain, rows = lifted(over(hills))
    assert len(nodes(plain)) == 4
    assert rows["10"].elevation_m > 1
    copy, rows = lifted(over(hills), options=Options(add_vertices=True, tolerance_m=0.01))
    assert_heights(copy, hills, 0.002)
    assert rows["10"].elevation_m <= 0.01
    street, area = refs(copy, 10), refs(copy, 11)
    assert [ref for ref in street if ref > 0] == [1, 2, 3]
    new = set(nodes(copy)) - set(nodes(plain))
    assert new == set(range(-6 - len(new), -6))
    assert set(street) == {1, 2, 3} | new
    between = street[street.index(2) : street.index(3) + 1]
    assert len(between) > 5
    assert area[: len(between)] == between[::-1]
    assert area[len(between) :] == [-6, 77]
    x, y = metres(*np.array([nodes(copy)[ref][:2] for ref in street]).T)
    s = np.hypot(np.diff(x), np.diff(y))
    assert s.min() > 0.5
    z = [nodes(copy)[ref][2] for ref in street]
    for i in range(len(street) - 1):
        middle = [(a[i] + a[i + 1]) / 2 for a in (x, y, z)]
        assert middle[2] == pytest.approx(float(hills(*middle[:2])), abs=0.013)
    assert copy.index('<node id="-7"') < copy.index("<way")


@pytest.mark.parametrize("ends", [False, True])
def test_nodes_beyond_the_surface_keep_what_they_had_or_go_on_level(lifted, ends):
    copy, rows = lifted(over(plane, lambda x, y: y < 20), options=Options(beyond="flat" if ends else "keep"))
    found = nodes(copy)
    assert found[3][2] == (found[2][2] if ends else 90)
    assert -6 not in found
    assert rows["10"].without_ground_m == pytest.approx(0.0005 * NORTH_M - 20, abs=1)


LOCAL = re.sub(r"lat=.50.55(\d+). lon=.9.0(\d+).", lambda each: 'lat="" lon=""', OSM)


def local(text: str = OSM) -> str:
    """The file with local coordinates (m) in tags, as Lanelet2 has them."""

    def place(node):
        x, y = metres(float(node[3]), float(node[2]))
        tags = f'<tag k="local_x" v="{x:.3f}"/><tag k="local_y" v="{y:.3f}"/>'
        return f'<node id="{node[1]}" lat="" lon="">{tags}</node>'

    return re.sub(
        r"<node id=.(-?\d+). lat=.([\d.]+). lon=.([\d.]+).[^>]*?(?:/>|>.*?</node>)",
        place,
        text,
        flags=re.DOTALL,
    )


def test_local_coordinates_are_used_where_there_are_no_others(lifted, tmp_path):
    def heights(x, y):
        return Heights((0,), plane(x, y)[None])

    copy, rows = lifted(heights, local(), Options(add_vertices=True))
    assert osm.frame(tmp_path / "a.osm") == Frame(None)
    for x, y, z in re.findall(r'local_x" v="(.*?)".*?local_y" v="(.*?)".*?ele" v="(.*?)"', copy):
        assert float(z) == pytest.approx(plane(float(x), float(y)), abs=6e-4)
    assert copy.count('k="ele"') == 5 + 1
    assert rows["10"].length_m == pytest.approx(0.001 * EAST_M + 0.0005 * NORTH_M, abs=0.01)
    copy, _ = lifted(lambda x, y: Heights((0,), hills(x, y)[None]), local(), Options(add_vertices=True))
    assert '<node id="-7" lat="" lon=""><tag k="local_x" v="' in copy
    lifted(over(plane))
    assert osm.frame(tmp_path / "a.osm") == Frame("EPSG:4326")


def street(name: int, nodes: str, tags: str) -> str:
    refs = "".join(f'<nd ref="{ref}"/>' for ref in nodes.split())
    return f'<way id="{name}">{refs}{tags}</way>\n'


def crossing(street_tags: str, deck_tags: str) -> str:
    """A street along y = 30 m in three ways, with a deck from 40 to 60 m, and one below it along x = 50 m."""
    places = [(0, 30), (41, 30), (59, 30), (100, 30), (50, 0), (50, 30), (50, 60), (50, 30)]
    text = "".join(
        f'<node id="{i}" lat="{SOUTH + y / NORTH_M:.9f}" lon="{WEST + x / EAST_M:.9f}"/>\n'
        for i, (x, y) in enumerate(places, 1)
    )
    ways = [street(i, refs, street_tags) for i, refs in ((1, "1 2"), (3, "3 4"), (4, "5 8"), (5, "8 7"))]
    return f"<osm>{text}{ways[0]}{street(2, '2 6 3', deck_tags)}{''.join(ways[1:])}</osm>"


def levels(number: int = 1, deck: bool = True):
    def heights(x, y):
        found = test_sumo.crossing(*metres(x, y))
        return Heights((0, number), found.z) if deck else Heights((0,), found.z[:1])

    return heights


HIGHWAY = '<tag k="highway" v="primary"/>'


@pytest.mark.parametrize(
    ("tags", "deck_tags"),
    [
        (HIGHWAY, HIGHWAY + '<tag k="bridge" v="yes"/><tag k="layer" v="2"/>'),
        ('<tag k="subtype" v="road"/>', '<tag k="subtype" v="road"/>'),
    ],
)
def test_ways_are_on_their_level_by_tags_or_as_they_go_on(lifted, tags, deck_tags):
    copy, rows = lifted(levels(), crossing(tags, deck_tags))
    heights = {i: z for i, (_, _, z) in nodes(copy).items()}
    assert heights == pytest.approx(
        {1: 100, 2: 100.82, 3: 101.18, 4: 102, 5: 94, 6: 101, 7: 94, 8: 94}, abs=6e-4
    )
    assert rows["2"].levels == (1,)
    assert rows["4"].levels == rows["5"].levels == (0,)
    assert rows["2"].unknown_deck_m == 0


def test_a_street_of_osm_without_tags_stays_below_a_deck(lifted):
    copy, _ = lifted(levels(), crossing(HIGHWAY, HIGHWAY))
    assert nodes(copy)[6][2] == nodes(copy)[8][2] == 94


def test_bridges_and_tunnels_without_their_level_are_told(lifted):
    bridge, tunnel = (HIGHWAY + f'<tag k="{kind}" v="yes"/>' for kind in ("bridge", "tunnel"))
    copy, rows = lifted(levels(deck=False), crossing(HIGHWAY, bridge))
    assert rows["2"].unknown_deck_m == pytest.approx(18, abs=0.01)
    assert nodes(copy)[6][2] == 94
    text = crossing(HIGHWAY, tunnel)
    copy, rows = lifted(levels(deck=False), text)
    assert set(nodes(copy)) == {1, 2, 3, 4, 5, 7, 8}
    assert rows["2"].unknown_deck_m == pytest.approx(18, abs=0.01)
    copy, rows = lifted(levels(-1), text)
    assert nodes(copy)[6][2] == pytest.approx(101)
    assert rows["2"].levels == (-1,)


@pytest.mark.parametrize("name", ['id="1"', 'ref="2"'])
def test_ids_that_are_no_numbers_are_refused_in_one_line(lifted, name):
    with pytest.raises(TaskError, match="has the id 'x', which is not a whole number"):
        lifted(over(plane), OSM.replace(name, name.split("=")[0] + '="x"'))


def test_a_file_without_nodes_or_ways_is_copied(lifted):
    assert lifted(over(plane), "<osm/>") == ("<osm/>", {})
    empty = '<osm><way id="1"><nd ref="3"/><nd ref="4"/></way><way id="2"/></osm>'
    copy, rows = lifted(over(plane), empty)
    assert (copy, rows) == (empty, {})
