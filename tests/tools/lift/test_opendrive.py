"""Roads of OpenDRIVE on surfaces of known heights, read back literally."""

from itertools import pairwise
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
import pytest

from flexroad.pipeline.run.sampler import Heights
from flexroad.tasks.errors import TaskError
from flexroad.tools.lift import opendrive, plan_view
from flexroad.tools.lift.plan_view import extent
from flexroad.tools.lift.road_profiles import cross_sections
from flexroad.tools.lift.types import Frame, Lifted, Options
from tests.read_opendrive import place, polynomial

LEVEL = 'level="false"'
LANES = """<lanes>
      <laneSection s="0">
        <left><lane id="1" type="driving" {0}><width sOffset="0" a="3.5" b="0" c="0" d="0"/></lane></left>
        <center><lane id="0" type="none" {0}/></center>
        <right>
          <lane id="-1" type="driving" {0}><width sOffset="0" a="3.5" b="0" c="0" d="0"/></lane>
          <lane id="-2" type="sidewalk" level="true"><height sOffset="0" inner="0.12" outer="0.12"/>
            <width sOffset="0" a="2" b="0" c="0" d="0"/><userData code="x" value="1"/></lane>
        </right>
      </laneSection>
    </lanes>"""
PROFILES = """<elevationProfile>
      <elevation s="0" a="1" b="0.01" c="0" d="0"/>
      <!-- a comment -->
      <elevation s="30" a="1.3" b="0" c="0" d="0"/>
    </elevationProfile>
    <lateralProfile/>"""
LINE = '<geometry s="0" x="10" y="20" hdg="0" length="{length}"><line/></geometry>'
ARC = '<geometry s="0" x="0" y="-100" hdg="0" length="{length}"><arc curvature="0.01"/></geometry>'


def road(
    plan: str = LINE,
    length: float = 60.0,
    name: str = "7",
    lanes: str | None = None,
    profiles: str = PROFILES,
    more: str = "",
) -> str:
    return f"""  <road name="R&amp;B" length="{length}" id="{name}" junction="-1">
    <link/>
    <planView>
      {plan.format(length=length)}
    </planView>
    {profiles}
    {LANES.format(LEVEL) if lanes is None else lanes}{more}
  </road>
"""


def document(*roads: str, header: str = "") -> str:
    head = f'<header revMajor="1" revMinor="6" name="ä">{header}</header>'
    return f'<?xml version="1.0"?>\n<OpenDRIVE>\n  {head}\n{"".join(roads)}</OpenDRIVE>\n'


def write(folder: Path, *roads: str, header: str = "") -> Path:
    path = folder / "in.xodr"
    path.write_text(document(*roads, header=header))
    return path


def lifted(source: Path, height, **options) -> tuple[ET.Element, list[Lifted]]:
    """Lift a file with heights of level 0; return the copy and its rows."""

    def heights(x, y):
        found = height(x, y)
        return found if isinstance(found, Heights) else Heights((0,), found[None])

    out = source.with_name("out.xodr")
    rows = list(opendrive.lift(source, out, heights, Options(**options)))
    return ET.parse(out).getroot(), rows


def elevation(element: ET.Element, s: float) -> float:
    return polynomial(element, "elevationProfile/elevation", s)


def places(element: ET.Element, right: float = -3.5, left: float = 3.5) -> np.ndarray:
    """Return places on the lanes of a road, read literally, ``(n, 3)``."""
    plan = plan_view.read(element)
    s = np.linspace(0, float(element.get("length")), 97)
    at = np.column_stack(plan.at(s))
    across = np.linspace(right, left, 9)
    return np.array([place(element, at[k], s[k], t) for k in range(len(s)) for t in across])


def plane(x, y):
    return 100 + 0.05 * x - 0.03 * y


def twisted(x, y):
    """Planar across a road along y = 20."""
    return 100 + np.sin(x / 12) + (0.02 + 0.03 * np.cos(x / 20)) * (y - 20)


def cone(x, y):
    """Planar across circles around the origin."""
    return 100 + 0.05 * np.hypot(x, y) + 0.5 * np.sin(7 * np.arctan2(x, -y))


def crowned(x, y):
    return 100 + 0.04 * x - 0.03 * np.sqrt((y - 20) ** 2 + 1) + 0.1 * np.sin(x / 9) * np.cos(y / 3)


@pytest.mark.parametrize(
    ("surface", "plan", "within"),
    [(plane, LINE, 1e-6), (twisted, LINE, 0.012), (cone, ARC, 0.012), (plane, ARC, 0.012)],
)
def test_lanes_lie_on_ground_that_is_planar_across(tmp_path, surface, plan, within):
    root, (row,) = lifted(write(tmp_path, road(plan)), surface)
    x, y, z = places(root.find("road")).T
    missed = np.abs(z - surface(x, y)).max()
    assert missed < within
    assert row.superelevation_m == pytest.approx(missed, abs=2e-3)
    assert row.elevation_m > 3 * row.superelevation_m
    assert row.without_ground_m == 0
    assert row.note == ""


def test_a_profile_on_a_plane_is_one_piece_with_its_slopes(tmp_path):
    root, (row,) = lifted(write(tmp_path, road()), plane)
    (elevation,) = root.findall("road/elevationProfile/elevation")
    (across,) = root.findall("road/lateralProfile/superelevation")
    found = [float(elevation.get("a")), float(elevation.get("b")), float(across.get("a"))]
    np.testing.assert_allclose(found, [plane(10, 20), 0.05, np.arctan(-0.03)], rtol=0, atol=1e-9)
    assert (row.grade, row.crossfall) == (pytest.approx(0.05), pytest.approx(0.03))
    # The file had heights of 1 to 1.3 m.
    x, y = np.meshgrid(np.linspace(10, 70, 61), [16.5, 23.5])
    old = np.where(x < 40, 1 + 0.01 * (x - 10), 1.3)
    assert row.before_m == pytest.approx(np.abs(plane(x, y) - old).max())


def test_roads_that_meet_have_one_height_and_one_grade(tmp_path):
    # The second comes from the other side, the third turns away on an arc, the fourth begins with a spiral.
    plans = [
        LINE,
        '<geometry s="0" x="110" y="20" hdg="3.141592653589793" length="{length}"><line/></geometry>',
        '<geometry s="0" x="70" y="20" hdg="0" length="{length}"><arc curvature="0.05"/></geometry>',
        '<geometry s="0" x="70" y="20" hdg="0" length="{length}"><spiral curvStart="0" curvEnd="-0.1"/>'
        "</geometry>",
    ]
    lengths = [60.0, 40.0, 9.4, 0.7]
    roads = [road(plan, long, str(k)) for k, (plan, long) in enumerate(zip(plans, lengths, strict=True))]
    root, _ = lifted(write(tmp_path, *roads), crowned)
    ends = []
    for element, at_end in zip(root.findall("road"), (True, True, False, False), strict=True):
        length = float(element.get("length"))
        s = length if at_end else 0.0
        z = elevation(element, s)
        step = 1e-4 * (-1 if at_end else 1)
        grade = (elevation(element, s + step) - z) / step
        ends.append((z, -grade if element.get("id") == "1" else grade))
    np.testing.assert_allclose(ends, [ends[0]] * 4, atol=1e-5)
    assert ends[0][0] == pytest.approx(float(crowned(70.0, 20.0)), abs=1e-9)


@pytest.mark.parametrize("lateral", ["superelevation", "none"])
@pytest.mark.parametrize(
    "profiles",
    [
        PROFILES,
        "",
        "<elevationProfile/>",
        "<lateralProfile></lateralProfile>",
        "<elevationProfile></elevationProfile>"
        '<lateralProfile><superelevation s="0" a="0.1" b="0" c="0" d="0"/>'
        '<crossfall side="left" s="0" a="0" b="0" c="0" d="0"/><shape s="0" t="0" a="0" b="0" c="0" d="0"/>'
        "<userData code='b'/></lateralProfile>",
    ],
)
def test_all_but_the_profiles_stays_as_it_was_written(tmp_path, lateral, profiles):
    more = (
        '\n    <objects><object id="1" s="3" t="1" zOffset="0.5"/></objects>\n    <myOwn a=\'1\'/><!-- b -->'
        '<surface><CRG file="a.crg" sStart="0" sEnd="60" orientation="same" mode="attached"/></surface>'
    )
    source = write(tmp_path, road(profiles=profiles, more=more), road(name="8", profiles=profiles))
    root, rows = lifted(source, twisted, lateral=lateral)
    assert [row.id for row in rows] == ["7", "8"]

    def rest(text: str) -> str:
        tree = ET.fromstring(text)
        for element in tree.iter("road"):
            for name, removed in (("elevationProfile", "elevation"), ("lateralProfile", "")):
                profile = element.find(name)
                for child in [] if profile is None else list(profile):
                    if child.tag in (removed, "superelevation", "crossfall", "shape"):
                        profile.remove(child)
                if profile is not None and not len(profile):
                    element.remove(profile)
        return ET.canonicalize(ET.tostring(tree, "unicode"), strip_text=True)

    before, after = source.read_text(), (tmp_path / "out.xodr").read_text()
    assert rest(before) == rest(after)
    for element in root.findall("road"):
        names = [each.tag for each in element]
        assert names[:3] == ["link", "planView", "elevationProfile"]
        assert (names[3] == "lateralProfile") == (lateral != "none" or "lateral" in profiles)
        assert element.find("elevationProfile/elevation") is not None
        assert len(element.findall("lateralProfile/crossfall")) == (
            lateral == "none" and "crossf" in profiles
        )
    # Text between the profiles and behind them is the same byte by byte.
    for part in ("<!-- a comment -->",) * (profiles is PROFILES) + (LANES.format(LEVEL) + more,):
        assert part in after
    assert before.partition("<road")[0] == after.partition("<road")[0]


@pytest.mark.parametrize("profiles", [PROFILES, ""])
def test_without_ground_a_road_keeps_its_profile(tmp_path, profiles):
    def until(x, y):
        return np.where(x < 40.5, plane(x, y), np.nan)

    root, (row,) = lifted(write(tmp_path, road(profiles=profiles)), until)
    first = root.find("road")
    for s in (0.0, 12.0, 29.9):
        assert elevation(first, s) == pytest.approx(plane(10 + s, 20))
    old = {30.1: 1.3, 59.0: 1.3} if profiles else {30.1: 0.0, 59.0: 0.0}
    for s, z in old.items():
        assert elevation(first, s) == pytest.approx(z)
    assert row.without_ground_m == pytest.approx(30.0)
    assert row.superelevation_m < 1e-6


def test_without_ground_a_road_goes_on_level_if_asked(tmp_path):
    def inner(x, y):
        return np.where((x > 20.5) & (x < 50.5), plane(x, y), np.nan)

    root, (row,) = lifted(write(tmp_path, road()), inner, beyond="flat")
    first = root.find("road")
    for s, z in ((0.0, plane(21, 20)), (11.0, plane(21, 20)), (25, plane(35, 20)), (60, plane(50, 20))):
        assert elevation(first, s) == pytest.approx(z)
    assert row.without_ground_m == pytest.approx(31.0)


def test_a_road_off_the_survey_stays_byte_by_byte(tmp_path):
    source = write(tmp_path, road())
    _, (row,) = lifted(source, lambda x, y: np.full(len(x), np.nan))
    assert (tmp_path / "out.xodr").read_bytes() == source.read_bytes()
    assert row.without_ground_m == row.length_m == 60


def decked(x, y):
    """A deck of level 1 from x = 30 to 50, 6 m above a dip in the ground."""
    dip = np.where((x > 30) & (x < 50), -6.0, 0.0)
    on = (x >= 30) & (x <= 50) & (np.abs(y - 20) < 5)
    return Heights((0, 1), np.stack([plane(x, y) + dip, np.where(on, plane(x, y), np.nan)]))


def structure(kind: str, s: float = 20.0, length: float = 20.0) -> str:
    return f'<objects><{kind} id="1" s="{s}" length="{length}" type="concrete"/></objects>'


@pytest.mark.parametrize("more", ["", structure("bridge")])
def test_a_bridge_is_on_its_deck(tmp_path, more):
    root, (row,) = lifted(write(tmp_path, road(more=more)), decked)
    x, y, z = places(root.find("road")).T
    assert np.abs(z - plane(x, y)).max() < 0.02
    assert row.levels == (0, 1)
    assert row.unknown_deck_m == 0


def test_a_road_below_a_deck_stays_on_the_ground(tmp_path):
    plan = '<geometry s="0" x="40" y="-10" hdg="1.5707963267948966" length="{length}"><line/></geometry>'

    def above(x, y):
        on = (np.abs(x - 40) < 20) & (np.abs(y - 20) < 5)
        return Heights((0, 1), np.stack([plane(x, y), np.where(on, plane(x, y) + 6, np.nan)]))

    root, (row,) = lifted(write(tmp_path, road(plan)), above)
    x, y, z = places(root.find("road")).T
    assert np.abs(z - plane(x, y)).max() < 1e-6
    assert row.levels == (0,)


@pytest.mark.parametrize(
    ("kind", "begin", "length", "hill_m"), [("bridge", 20.0, 20.0, 0.0), ("tunnel", 19.5, 21.0, 9.0)]
)
def test_a_bridge_or_tunnel_without_its_level_joins_its_ends_and_is_named(
    tmp_path, kind, begin, length, hill_m
):
    def above(x, y):
        return plane(x, y) + np.where((x > 30) & (x < 50), hill_m, 0.0)

    root, (row,) = lifted(write(tmp_path, road(more=structure(kind, begin, length))), above)
    x, y, z = places(root.find("road")).T
    assert np.abs(z - plane(x, y)).max() < 0.02
    assert (row.unknown_deck_m, row.without_ground_m) == (length, 0)


def test_level_lanes_are_not_superelevated_and_named(tmp_path):
    lanes = LANES.format('level="true"')
    _, (row,) = lifted(write(tmp_path, road(lanes=lanes)), plane)
    assert row.elevation_m == row.superelevation_m > 0.1
    assert 'level="true"' in row.note


def in_line(number: int) -> list[str]:
    """Roads of 12 m from x = 8 on, each linked with the one before it and the one after it."""
    roads = []
    for k in range(1, number + 1):
        plan = f'<geometry s="0" x="{12 * k - 4}" y="20" hdg="0" length="{{length}}"><line/></geometry>'
        before = f'<predecessor elementType="road" elementId="{k - 1}" contactPoint="end"/>' if k > 1 else ""
        after = f'<successor elementType="road" elementId="{k + 1}" contactPoint="start"/>'
        links = f"<link>{before}{after if k < number else ''}</link>"
        roads.append(road(plan, 12.0, str(k), profiles="").replace("<link/>", links))
    return roads


@pytest.mark.parametrize("order", [1, -1])
def test_a_road_with_several_levels_goes_on_where_its_links_do(tmp_path, order):
    # Three roads in line below a wide deck, of which the first comes from outside; one alone is on the deck.
    def covered(x, y):
        return Heights((0, 1), np.stack([plane(x, y), np.where(x > 15, plane(x, y) + 6, np.nan)]))

    alone = road(LINE.replace('x="10"', 'x="60"'), 12.0, "4", profiles="")
    roads = [*in_line(3), alone]
    root, rows = lifted(write(tmp_path, *roads[::order]), covered)
    levels = {row.id: row.levels for row in rows}
    assert levels == {"1": (0,), "2": (0,), "3": (0,), "4": (1,)}
    assert [row.id for row in rows if "nothing that it meets says which" in row.note] == ["4"]
    heights = {each.get("id"): elevation(each, 6) for each in root.iter("road")}
    assert heights["3"] == pytest.approx(plane(38, 20))
    assert heights["4"] == pytest.approx(plane(66, 20) + 6)


@pytest.mark.parametrize("order", [1, -1])
def test_roads_beyond_the_surface_go_on_level_as_those_that_they_are_linked_with(tmp_path, order):
    """Of five roads in line, the first and the last leave the surface; they differ by 2.5 m."""

    def ends(x, y):
        return np.where(np.abs(x - 38) > 24.5, 100 + 0.05 * x, np.nan)

    root, rows = lifted(write(tmp_path, *in_line(5)[::order]), ends, beyond="flat")
    z = {each.get("id"): [elevation(each, s) for s in (0, 6, 12)] for each in root.iter("road")}
    # The surface ends at x = 13, and begins again at x = 63.
    assert z["1"] == pytest.approx([100.4, 100.65, 100.65])
    assert z["5"][:2] == pytest.approx([103.15, 103.15])
    for a, b in pairwise("12345"):
        assert z[a][2] == pytest.approx(z[b][0])
    assert sorted(row.without_ground_m for row in rows) == pytest.approx([7, 7, 12, 12, 12])


def test_a_tunnel_in_two_roads_does_not_climb_the_hill(tmp_path):
    def hill(x, y):
        return plane(x, y) + np.where((x > 14.5) & (x < 25.5), 9.0, 0.0)

    ends = ((6.0, 6.0), (0.0, 6.0))
    tunnels = [
        each.replace("</lanes>", f"</lanes>{structure('tunnel', *end)}")
        for each, end in zip(in_line(2), ends, strict=True)
    ]
    root, _ = lifted(write(tmp_path, *tunnels), hill, beyond="flat")
    first, second = ([elevation(each, s) for s in (0, 12)] for each in root.iter("road"))
    assert first[1] == pytest.approx(second[0])
    assert max(*first, *second) < 101.6


LANE = '<lane id="{0}" type="driving"><width sOffset="0" a="{1}" b="{2}" c="0" d="0"/></lane>'
OTHER_LANES = [
    # Shifted, and wider along the road.
    (
        '<lanes><laneOffset s="0" a="2" b="0.01" c="0" d="0"/><laneSection s="0"><right>'
        f"{LANE.format(-1, 3, 0.02)}{LANE.format(-2, 1, 0)}</right></laneSection></lanes>",
        lambda s: (2 + 0.01 * s - (4 + 0.02 * s), 2 + 0.01 * s),
    ),
    # Borders; the second section has a side of its own.
    (
        '<lanes><laneSection s="0"><left><lane id="1" type="driving"><border sOffset="0" a="4" b="0" c="0" '
        f'd="0"/></lane></left><right>{LANE.format(-1, 3, 0)}</right></laneSection>'
        f'<laneSection s="20" singleSide="true"><right>{LANE.format(-1, 5, 0)}</right></laneSection></lanes>',
        lambda s: (np.where(s < 20, -3, -5), 4.0 + 0 * s),
    ),
]


@pytest.mark.parametrize(("text", "expected"), OTHER_LANES)
def test_extent_of_lanes_follows_offsets_widths_borders_and_sections(text, expected):
    s = np.linspace(0, 60, 13)
    found = extent(ET.fromstring(f"<road>{text}</road>"), s)
    right, left = expected(s)
    np.testing.assert_allclose(found.right, right)
    np.testing.assert_allclose(found.left, left)


HUGE = LINE.replace('hdg="0"', 'hdg="1e308"').replace("<line/>", '<arc curvature="1e308"/>')
BAD = [
    (road(HUGE), "places that are not numbers"),
    (road(length=0.0), "has a length of 0 m"),
    (road().replace('length="60.0" id', "id"), "has road without length"),
    (road().replace('length="60.0" id', 'length="1e9" id'), "has a length of 1e+09 m"),
    (road().replace('x="10"', 'x="nan"'), "x 'nan', which is not a number"),
    (road().replace("<line/>", ""), "not a line, arc"),
    (road(plan=""), "no planView with a geometry"),
    (road(plan=LINE.replace('s="0"', 's="9"') + LINE), "s that does not ascend"),
    (road().replace('b="0.01"', 'b="x"'), "elevation with b 'x'"),
    (road().replace('a="3.5"', 'a="inf"'), "width with a 'inf'"),
]


@pytest.mark.parametrize(("text", "words"), BAD)
def test_a_road_that_cannot_be_read_stays_and_is_named(tmp_path, text, words):
    root, (bad, good) = lifted(write(tmp_path, text, road(name="8")), plane)
    assert words in bad.note
    assert bad.id == "7"
    assert bad.note.endswith("; it stays as it was")
    assert "\n" not in bad.note
    assert text in (tmp_path / "out.xodr").read_text()
    assert good.superelevation_m < 1e-6
    assert len(root.findall("road")) == 2


@pytest.mark.parametrize(
    ("header", "expected"),
    [
        ("", Frame(None)),
        ("<geoReference/>", Frame(None)),
        ("<geoReference>EPSG:25832</geoReference>", Frame("EPSG:25832")),
        (
            "<geoReference>\n <![CDATA[\n+proj=utm  +zone=32\n]]></geoReference>"
            '<offset x="1.5" y="-2" z="3" hdg="0.1"/>',
            Frame("+proj=utm +zone=32", 1.5, -2.0, 3.0, 0.1),
        ),
    ],
)
def test_the_frame_is_that_of_the_header(tmp_path, header, expected):
    assert opendrive.frame(write(tmp_path, road(), header=header)) == expected


def test_an_offset_that_is_no_number_is_refused(tmp_path):
    with pytest.raises(TaskError, match="offset with x 'b'"):
        opendrive.frame(write(tmp_path, header="<offset x='b'/>"))


def test_places_above_limits_are_the_steepest_of_their_stretch(tmp_path):
    _, (row,) = lifted(write(tmp_path, road()), twisted, grade_limit=0.08, crossfall_limit=0.0499)
    grades = [each for each in row.steep if each.kind == "grade"]
    # The slope is cos(x / 12) / 12: steepest at x = 12 pi.
    assert [round(each.value, 4) for each in grades] == [0.0833]
    assert grades[0].x == pytest.approx(12 * np.pi, abs=0.6)
    assert grades[0].y == pytest.approx(20)
    # 0.02 + 0.03 cos(x / 20) is 0.046 at most here.
    assert [each.kind for each in row.steep] == ["grade"]


def test_large_roads_have_no_more_points_than_they_need(tmp_path):
    asked = []

    def counted(x, y):
        asked.append(len(x))
        return plane(x, y)

    narrow = ARC.replace("0.01", "5")
    wide = LANES.format(LEVEL).replace('a="3.5"', 'a="150"')
    roads = [road(narrow, 9000.0), road(LINE, 6000.0, "8", lanes=wide)]
    lifted(write(tmp_path, *roads), counted)
    assert sum(asked) < 800_000


def test_a_single_place_with_ground_is_no_part_of_a_profile():
    on = np.array([100.0, 100.1, np.nan, 100.3, np.nan, np.nan, 100.6, 100.7, np.nan, 100.9])
    s, t = np.arange(10.0), np.array([-2.0, 0.0, 2.0])
    z = np.broadcast_to(on[:, None], (10, 3))
    found = cross_sections(s, t, z, (on, on, on), np.ones((10, 3), np.bool_), np.zeros(10, np.bool_))
    np.testing.assert_array_equal(
        found.line, [100.0, 100.1, np.nan, np.nan, np.nan, np.nan, 100.6, 100.7, np.nan, np.nan]
    )
