"""Features on surfaces of known heights: tolerance, levels and batches; and their WKB, against shapely."""

import struct

import numpy as np
import pytest
import shapely
from shapely import LineString, Point, Polygon

from flexroad.pipeline.run.sampler import Heights
from flexroad.tasks.errors import TaskError
from flexroad.tools.lift import features, types
from flexroad.tools.lift.features import Feature, grades, level_columns, lifted, wanted_levels
from flexroad.tools.lift.network import ANY
from flexroad.tools.lift.shapes import of_wkb, to_wkb
from flexroad.tools.lift.types import Options


class Waves:
    """A surface of waves, with a deck 6 m above it from x = 40 to 60 if it is to have one."""

    bounds = (0.0, -50.0, 1000.0, 50.0)

    def __init__(self, deck: bool = False) -> None:
        self.deck, self.calls, self.largest = deck, 0, 0

    def to_run(self, x, y):
        return x, y

    def height(self, x, y):
        return 2 * np.sin(x / 9) + 0.3 * np.cos(y / 4)

    def at(self, x, y):
        self.calls, self.largest = self.calls + 1, max(self.largest, len(x))
        inside = (x >= 0) & (x <= 1000)
        ground = np.where(inside, self.height(x, y), np.nan)
        if not self.deck:
            return Heights((0,), ground[None])
        return Heights((0, 1), np.stack([ground, np.where((x >= 40) & (x <= 60), ground + 6, np.nan)]))

    def errors(self, x, y, numbers):
        return np.full(len(x), 0.01) + x / 1e5


def feature(shape, wanted=int(ANY)) -> Feature:
    return Feature("a", of_wkb(shapely.to_wkb(shape)), wanted)


def one(shape, run, wanted=int(ANY), **options):
    ((new, row),) = lifted([feature(shape, wanted)], run, Options(**options))
    return shapely.from_wkb(to_wkb(new)), row


def distance(shape, run) -> float:
    """Largest distance in height of a line from a surface, at points 1 cm apart."""
    x, y, z = shapely.get_coordinates(shape, include_z=True).T
    s = np.concatenate([[0], np.cumsum(np.hypot(np.diff(x), np.diff(y)))])
    at = np.arange(0, s[-1], 0.01)
    on = run.height(np.interp(at, s, x), np.interp(at, s, y))
    return float(np.abs(np.interp(at, s, z) - on).max())


@pytest.mark.parametrize("tolerance", [0.005, 0.05])
@pytest.mark.parametrize("shape", [LineString([(1, 2), (90, 30)]), Polygon([(5, 5), (60, 8), (30, 30)])])
def test_lines_and_rings_stay_within_the_tolerance(shape, tolerance):
    run = Waves()
    new, row = one(shape, run, tolerance_m=tolerance)
    ring = new.exterior if new.geom_type == "Polygon" else new
    # The surface is looked up every 0.5 m: between, it bends by less than a millimetre here.
    assert distance(ring, run) <= tolerance + 0.001
    assert row.elevation_m <= tolerance
    assert row.length_m == pytest.approx(shape.length)
    x, y, z = shapely.get_coordinates(new, include_z=True).T
    np.testing.assert_allclose(z, run.height(x, y), atol=1e-9)
    assert new.is_valid


def test_fewer_vertices_with_a_larger_tolerance_and_none_if_not_wanted():
    line, run = LineString([(1, 2), (90, 30)]), Waves()
    counts = [len(one(line, run, tolerance_m=t)[0].coords) for t in (0.002, 0.02, 0.2)]
    assert counts == sorted(counts, reverse=True)
    assert counts[0] > counts[2] > 2
    assert len(one(line, run, add_vertices=False)[0].coords) == 2


def test_line_or_point_over_a_deck_takes_it_by_its_level_or_by_continuity():
    run, line = Waves(deck=True), LineString([(10, 0), (90, 0)])
    below, row = one(line, run)
    assert row.levels == (0,)
    assert distance(below, run) < 0.006
    on_deck, row = one(LineString([(41, 0), (59, 0)]), run)
    assert row.levels == (1,)
    assert on_deck.coords[0][2] == pytest.approx(run.height(41, 0) + 6)
    _, row = one(LineString([(41, 0), (59, 0)]), run, wanted=0)
    assert row.levels == (0,)
    _, row = one(line, run, wanted=1)
    assert row.unknown_deck_m == pytest.approx(60, abs=1)
    # A point takes the highest level if nothing names another.
    assert one(Point(50, 0), run)[0].z == pytest.approx(run.height(50, 0) + 6)
    assert one(Point(50, 0), run, wanted=0)[0].z == pytest.approx(run.height(50, 0))


def test_batches_of_points_give_what_one_does(monkeypatch):
    shapes = [LineString([(x, 0), (x + 20, 5)]) for x in range(0, 200, 3)] + [Point(5, 5)] * 10
    wanted = [feature(shape) for shape in shapes]
    whole = [(to_wkb(shape), row) for shape, row in lifted(wanted, Waves(), Options())]
    monkeypatch.setattr(features, "POINTS", 100)
    run = Waves()
    parts = [(to_wkb(shape), row) for shape, row in lifted(wanted, run, Options())]
    assert [data for data, _ in parts] == [data for data, _ in whole]
    assert [row.length_m for _, row in parts] == pytest.approx(
        [row.length_m for _, row in whole], nan_ok=True
    )
    assert run.largest <= 100 < run.calls * 100


def test_a_line_far_longer_than_the_run_is_not_sampled_off_it():
    run = Waves()
    _, row = one(LineString([(-5e7, 500), (5e7, 500)]), run)
    assert run.largest == 2
    assert row.without_ground_m == pytest.approx(1e8)
    _, row = one(LineString([(-5e7, 0), (5e7, 0)]), run)
    assert run.largest <= features.MOST_PIECES + 2


def test_columns_have_the_crossfall_of_lines_and_the_largest_error():
    _, row = one(LineString([(0, 2 * np.pi), (900, 2 * np.pi)]), Waves(), columns=True)
    assert row.crossfall == pytest.approx(0.3 / 4, rel=0.02)
    assert row.error_m == pytest.approx(0.019, abs=1e-4)


def test_grades_of_short_segments_are_over_the_wanted_distance():
    s, z = np.array([0.0, 0.1, 0.2, 0.6, 1.2]), np.array([0.0, 0.1, 0.0, 0.0, 0.6])
    np.testing.assert_allclose(grades(s, z, 0.5), [0, -0.2, 0.6, 1, np.nan])
    np.testing.assert_allclose(grades(s[:2], z[:2], 0.5), [1, np.nan])
    np.testing.assert_allclose(grades(np.zeros(2), z[:2], 0.5), [np.nan, np.nan])


def test_levels_are_read_from_columns_that_say_them():
    assert level_columns(["name", "Layer"]) == []
    assert level_columns(["Bridge", "layer", "b"]) == ["Bridge", "layer"]
    assert wanted_levels({"Bridge": ["yes", None], "layer": ["2", "1"]}, 2) == [2, 0]
    assert wanted_levels({}, 2) == [ANY, ANY]


def test_each_part_has_its_heights_in_order_whatever_the_batch(monkeypatch):
    asked = []

    def heights(x, y):
        asked.append(len(x))
        return Heights((0,), (x + y)[None])

    parts = [*"ab", 3, 0, *"c", 5]
    for size in (1, 4, 100):
        monkeypatch.setattr(types, "POINTS", size)
        found = types.with_heights(
            parts,
            lambda part: types.NO_POINTS if isinstance(part, str) else (np.arange(part), np.ones(part)),
            heights,
        )
        result = [(part, own.ground.tolist()) for part, own in found]
        assert [part for part, _ in result] == parts
        assert [own for _, own in result] == [[], [], [1, 2, 3], [], [], [1, 2, 3, 4, 5]]
    assert asked[-1] == 8


TEXTS = [
    *("POINT (1 2)", "POINT EMPTY", "LINESTRING (1 2, 3 4)", "LINESTRING EMPTY", "POLYGON EMPTY"),
    *("POLYGON ((0 0, 4 0, 4 4, 0 0), (1 1, 2 1, 2 2, 1 1))", "MULTIPOINT ((1 2), (3 4))"),
    *("MULTILINESTRING ((1 2, 3 4), (5 6, 7 8))", "MULTIPOLYGON (((0 0, 4 0, 4 4, 0 0)))"),
    "GEOMETRYCOLLECTION (POINT (1 2), GEOMETRYCOLLECTION (LINESTRING (1 2, 3 4)), POLYGON EMPTY)",
    *("POINT Z (1 2 3)", "LINESTRING Z (1 2 3, 4 5 6)", "LINESTRING M (1 2 3, 4 5 6)", "POINT ZM (1 2 3 4)"),
]


@pytest.mark.parametrize("text", TEXTS)
@pytest.mark.parametrize("form", [{"flavor": "iso"}, {"byte_order": 0}, {"include_srid": True}])
def test_geometry_read_and_written_is_the_same(text, form):
    shape = shapely.from_wkt(text)
    if "include_srid" in form:
        shape = shapely.set_srid(shape, 25832)
    data = shapely.to_wkb(shape, **form)
    assert to_wkb(of_wkb(data)) == shapely.to_wkb(shapely.set_srid(shape, 0), flavor="iso", byte_order=1)


@pytest.mark.parametrize("text", TEXTS)
def test_cut_geometry_is_an_error(text):
    data = shapely.to_wkb(shapely.from_wkt(text))
    for end in range(0, len(data) - 1, 3):
        with pytest.raises(TaskError, match="damaged geometry"):
            of_wkb(data[:end])


def test_geometry_with_a_false_number_of_points_is_an_error():
    with pytest.raises(TaskError, match="damaged geometry"):
        of_wkb(struct.pack("<BII", 1, 2, 2**32 - 1))


def test_collections_too_deep_within_each_other_are_an_error():
    with pytest.raises(TaskError, match="more than 32 collections"):
        of_wkb(struct.pack("<BII", 1, 7, 1) * 1000)


@pytest.mark.parametrize(
    ("code", "name"), [(1009, "CompoundCurve"), (1016, "TIN"), (999, "of the number 999")]
)
def test_curves_and_surfaces_are_an_error_that_names_them(code, name):
    with pytest.raises(TaskError, match=f"has a geometry of the type {name}; write it"):
        of_wkb(struct.pack("<BI", 1, code))
