"""The file against the surface, by a parser of the standard's syntax and geomdl; its part against SciPy."""

import json
import re
from dataclasses import replace
from datetime import datetime

import numpy as np
import pytest
from geomdl import NURBS, BSpline
from scipy.interpolate import BSpline as SciPySpline

from flexroad.catalog.grid import Grid
from flexroad.tasks.errors import TaskError
from flexroad.tasks.spline.surface import NurbsSurface
from flexroad.tasks.types import RoadMask
from flexroad.tools.export import step
from flexroad.tools.export.georeference import Georeference
from flexroad.tools.export.step import covered, cut, patch
from tests.builders import make_surface
from tests.validators.opencascade import read_step

BOUNDS = (295450.0, 5629200.0, 295800.0, 5629550.0)
CORE = (295500.0, 5629250.0, 295750.0, 5629500.0)
PLACE = Georeference("EPSG:25832", (295000.0, 5629100.0, 0.0), "EPSG:7837")
"""What all tiles of a run are relative to."""
WRITTEN = datetime(2026, 5, 4, 3, 2, 1)


def surface(weights: bool) -> NurbsSurface:
    knots = "clamped" if weights else "uniform"
    return make_surface((12, 14), (3, 3), knots, weights, 7, BOUNDS)


def encoded(weights: bool) -> str:
    return step.encode(surface(weights), CORE, "295500_5629250", WRITTEN, PLACE).decode("ascii")


def entities(text: str) -> dict[str, str]:
    """Return the entities of the data section by their reference."""
    data = text[text.index("DATA;\n") : text.index("ENDSEC;\nEND-ISO")]
    found = re.findall(r"^(#\d+)=(.*);$", data, re.MULTILINE)
    assert len(found) == data.count("\n") - 1
    return dict(found)


def arguments(text: str) -> list:
    """Return the arguments of an entity, lists as lists, all others as text."""
    nested = re.sub(r"(#\d+|\.\w+\.|-?\d[\d.E+-]*|'[^']*'|\*|\$)", lambda m: json.dumps(m[0]), text)
    return json.loads(nested.replace("(", "[").replace(")", "]"))


def spline(table: dict[str, str], reference: str, kind: str) -> list:
    """Return form and knots of a B-spline curve or surface, and its weights or None."""
    text = table[reference]
    if not text.startswith("("):
        return [*arguments(text.removeprefix(f"B_SPLINE_{kind}_WITH_KNOTS"))[1:], None]
    parts = {
        name: arguments(re.search(rf"\b{name}(\(.*?\))(?=[A-Z_]+\(|\)$)", text)[1])
        for name in (f"B_SPLINE_{kind}", f"B_SPLINE_{kind}_WITH_KNOTS", f"RATIONAL_B_SPLINE_{kind}")
    }
    form, knots, (weights,) = parts.values()
    return [*form, *knots, weights]


def points(table, references) -> np.ndarray:
    if isinstance(references, list):
        return np.array([points(table, item) for item in references])
    return np.array(arguments(table[references].removeprefix("CARTESIAN_POINT"))[1], float)


def repeated(counts, values) -> list[float]:
    return np.repeat(np.array(values, float), np.array(counts, int)).tolist()


def the(table: dict[str, str], name: str) -> list[str]:
    return [reference for reference, text in table.items() if text.startswith(name)]


def read_surface(text: str):
    """Return the only surface as geomdl evaluates it."""
    table = entities(text)
    (face,) = the(table, "ADVANCED_FACE")
    _, _, reference, sense = arguments(table[face].removeprefix("ADVANCED_FACE"))
    assert sense == ".T."
    p, q, net, _, *_, mu, mv, ku, kv, _, weights = spline(table, reference, "SURFACE")
    control = points(table, net)
    peer = BSpline.Surface() if weights is None else NURBS.Surface()
    peer.degree_u, peer.degree_v = int(p), int(q)
    if weights is None:
        peer.ctrlpts2d = control.tolist()
    else:
        w = np.array(weights, float)[..., None]
        peer.ctrlpts2d = np.concatenate([control * w, w], axis=-1).tolist()
    peer.knotvector_u, peer.knotvector_v = repeated(mu, ku), repeated(mv, kv)
    return peer


def read_curve(table: dict[str, str], reference: str, t: float) -> np.ndarray:
    degree, net, _, _, _, counts, values, _, weights = spline(table, reference, "CURVE")
    control = points(table, net)
    peer = BSpline.Curve() if weights is None else NURBS.Curve()
    peer.degree = int(degree)
    if weights is None:
        peer.ctrlpts = control.tolist()
    else:
        w = np.array(weights, float)[:, None]
        peer.ctrlptsw = np.concatenate([control * w, w], axis=-1).tolist()
    peer.knotvector = repeated(counts, values)
    return np.array(peer.evaluate_single(t))


@pytest.mark.parametrize("weights", [False, True])
def test_encode_evaluated_by_geomdl_equals_surface(weights):
    peer, truth = read_surface(encoded(weights)), surface(weights)
    assert (peer.degree_u, peer.degree_v) == ((4, 4) if weights else (3, 3))
    assert peer.rational == weights
    for u, v in [(0, 0), (1, 1), (0, 1), (0.5, 0.5), (0.123, 0.77), (0.9, 0.31)]:
        x, y, z = peer.evaluate_single((u, v))
        assert x == pytest.approx(500 + 250 * u, abs=1e-9)
        assert y == pytest.approx(150 + 250 * v, abs=1e-9)
        # A northing has a rounding error of 1e-9 m, and slopes here are below 1.
        assert z == pytest.approx(float(truth.height(CORE[0] + 250 * u, CORE[1] + 250 * v)), abs=2e-9)


@pytest.mark.slow
@pytest.mark.parametrize("weights", [False, True])
def test_encode_read_by_opencascade_is_valid_and_equals_surface(tmp_path, weights):
    (tmp_path / "tile.step").write_text(encoded(weights))
    valid, points = read_step(tmp_path / "tile.step", 9)
    assert valid
    x, y, z = points.T
    assert (x.min(), x.max(), y.min(), y.max()) == pytest.approx((500, 750, 150, 400), abs=1e-9)
    np.testing.assert_allclose(
        z, surface(weights).height(PLACE.origin[0] + x, PLACE.origin[1] + y), rtol=0, atol=2e-9
    )


@pytest.mark.parametrize("weights", [False, True])
def test_encode_edges_are_the_borders_counter_clockwise(weights):
    text = encoded(weights)
    table, peer = entities(text), read_surface(text)
    (loop,) = the(table, "EDGE_LOOP")
    corners = [(0, 0), (1, 0), (1, 1), (0, 1), (0, 0)]
    for k, oriented in enumerate(arguments(table[loop].removeprefix("EDGE_LOOP"))[1]):
        *_, edge, along = arguments(table[oriented].removeprefix("ORIENTED_EDGE"))
        _, start, end, curve, same = arguments(table[edge].removeprefix("EDGE_CURVE"))
        assert same == ".T."
        turn = corners[k : k + 2] if along == ".T." else corners[k : k + 2][::-1]
        for vertex, corner in zip((start, end), turn, strict=True):
            _, point = arguments(table[vertex].removeprefix("VERTEX_POINT"))
            np.testing.assert_allclose(points(table, point), peer.evaluate_single(corner), atol=1e-9)
        for t in (0, 0.3, 1):
            place = tuple((1 - t) * a + t * b for a, b in zip(*turn, strict=True))
            np.testing.assert_allclose(read_curve(table, curve, t), peer.evaluate_single(place), atol=1e-9)


def test_encode_references_have_entities():
    table = entities(encoded(True))
    used = {reference for text in table.values() for reference in re.findall(r"#\d+", text)}
    assert used <= set(table)
    unused = set(table) - used
    roots = {
        "APPLICATION_PROTOCOL_DEFINITION",
        "PRODUCT_RELATED_PRODUCT_CATEGORY",
        "SHAPE_DEFINITION_REPRESENTATION",
    }
    assert {table[reference].partition("(")[0] for reference in unused} == roots


def test_encode_head_has_schema_time_and_place():
    text = encoded(False)
    assert "FILE_SCHEMA(('AUTOMOTIVE_DESIGN { 1 0 10303 214 1 1 1 1 }'));" in text
    assert "FILE_NAME('295500_5629250','2026-05-04T03:02:01'," in text
    assert "'origin 295000 5629100 0 (easting northing height, m)','crs EPSG:25832'" in text
    assert "'vertical crs EPSG:7837'" in text
    assert "SI_UNIT($,.METRE.)" in text


def test_encode_long_and_foreign_text_is_divided_and_escaped():
    wkt = "PROJCRS['Réunion'," + "x" * 600 + "]"
    long = replace(surface(False), crs=wkt)
    place = Georeference(wkt, (0.0, 0.0, 0.0))
    text = step.encode(long, CORE, "tîle 'a'\\b", WRITTEN, place).decode("ascii")
    (description,) = re.findall(r"FILE_DESCRIPTION\((.*),'2;1'\);", text)
    assert max(map(len, re.findall(r"'((?:[^']|'')*)'", description))) <= 256
    assert r"PRODUCT('t\X4\000000EE\X0\le ''a''\\b'," in text


AREA = (295500.0, 5629250.0, 295750.0, 5629450.0)
WITHIN = (295512.3, 5629250.0, 295730.0, 5629444.4)


def whole(degree=(3, 2), knots="uniform", weights=False) -> NurbsSurface:
    return make_surface((17, 20), degree, knots, weights, 5, AREA)


def evaluated(nurbs, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Return points of a NURBS by SciPy, ``(len(v), len(u), 3)``."""
    nu = SciPySpline(nurbs.knots_u, np.eye(nurbs.points.shape[1]), nurbs.degree[0])(u)
    nv = SciPySpline(nurbs.knots_v, np.eye(nurbs.points.shape[0]), nurbs.degree[1])(v)
    w = nurbs.points[..., 3:]
    homogeneous = np.einsum("ai,bj,ijc->abc", nv, nu, np.concatenate([nurbs.points[..., :3] * w, w], -1))
    return homogeneous[..., :3] / homogeneous[..., 3:]


@pytest.mark.parametrize("degree", [(3, 3), (1, 2), (5, 4)])
@pytest.mark.parametrize("knots", ["uniform", "clamped"])
@pytest.mark.parametrize("weights", [False, True])
@pytest.mark.parametrize("bounds", [WITHIN, AREA, (295400.0, 5629300.0, 295600.0, 5629999.0)])
def test_patch_equals_surface_within_a_nanometre(degree, knots, weights, bounds):
    truth = whole(degree, knots, weights)
    nurbs, rational = patch(truth, bounds, truth.origin)
    assert rational == weights
    assert nurbs.degree == tuple(p + weights for p in degree)
    (west, south), (east, north) = np.maximum(bounds[:2], AREA[:2]), np.minimum(bounds[2:], AREA[2:])
    t = np.linspace(0, 1, 41)
    x, y = west + (east - west) * t, south + (north - south) * t
    found = np.moveaxis(evaluated(nurbs, t, t), -1, 0)
    np.testing.assert_allclose(found[:2], np.meshgrid(x - 295500, y - 5629250), rtol=0, atol=1e-9)
    # The surface's own heights have the rounding error of a northing, 1e-9 m, times the slope.
    steepest = max(np.abs(slope).max() for slope in truth.slope(*np.meshgrid(x, y)))
    np.testing.assert_allclose(found[2], truth.lattice(x, y), rtol=0, atol=1e-9 * (1 + steepest))


def test_patch_of_equal_weights_other_than_1_is_not_rational():
    ones = whole()
    nurbs, rational = patch(replace(ones, A=2.5 * ones.A, W=2.5 * ones.W), WITHIN, ones.origin)
    assert not rational
    np.testing.assert_allclose(nurbs.points, patch(ones, WITHIN, ones.origin)[0].points, atol=5e-9)
    np.testing.assert_array_equal(nurbs.points[..., 3], 1)


def test_cut_is_clamped_and_has_the_knots_of_the_part():
    part = cut(whole(), WITHIN)
    assert part.bounds == WITHIN
    for knots, degree in ((part.knots_u, 3), (part.knots_v, 2)):
        np.testing.assert_array_equal(knots[: degree + 1], 0)
        np.testing.assert_array_equal(knots[-degree - 1 :], 1)
        assert ((knots > 0) & (knots < 1)).sum() == len(knots) - 2 * degree - 2
    # Knots are 250 / 17 m apart along easting; the part is from 12.3 m to 230 m.
    inner = 295500 + np.arange(1, 16) * 250 / 17
    np.testing.assert_allclose(295512.3 + part.knots_u[4:-4] * 217.7, inner, atol=1e-9)


def test_cut_has_no_narrow_span_and_as_few_points_as_possible():
    part = cut(whole(), (295500 + 5 * 250 / 17 + 1e-10, *AREA[1:]))
    assert np.diff(part.knots_u)[np.diff(part.knots_u) > 0].min() > 0.05
    assert cut(whole(), (295501.0, 5629251.0, 295502.0, 5629252.0)).A.shape == (3, 4)
    with pytest.raises(TaskError, match=r"bounds 0 0 1 1 lie beyond the surface's domain 295500 5629250"):
        cut(whole(), (0, 0, 1, 1))


TILE = Grid("EPSG:25832", 295500.0, 5629500.0, 2.0, 5, 4)


@pytest.mark.parametrize(
    ("survey", "halo", "bounds", "beyond_m2"),
    [
        ("##### ##### ##### #####", 0, TILE.bounds, 0.0),
        ("..... ...#. ..##. .....", 0, (295504.0, 5629494.0, 295508.0, 5629498.0), 4.0),
        ("..... ..... ..... .....", 0, TILE.bounds, 80.0),
        # A halo of one cell is beyond the survey.
        ("....... .#####. .#####. .#####. .#####. .......", 1, TILE.bounds, 0.0),
    ],
    ids=["complete", "part", "nothing", "halo"],
)
def test_covered_is_the_rectangle_around_the_cells_of_the_core_with_data(survey, halo, bounds, beyond_m2):
    outside = np.array([list(row) for row in survey.split()]) == "."
    grid = Grid(TILE.crs, TILE.west - 2 * halo, TILE.north + 2 * halo, 2.0, 5 + 2 * halo, 4 + 2 * halo)
    assert covered(RoadMask(grid, TILE, np.zeros(grid.shape, bool), outside)) == (bounds, beyond_m2)
