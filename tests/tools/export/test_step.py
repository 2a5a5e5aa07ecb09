"""The file against the surface: read by a parser of the standard's syntax, evaluated by geomdl."""

import json
import re
from datetime import datetime

import numpy as np
import pytest
from geomdl import NURBS, BSpline

from flexroad.tasks.spline.surface import NurbsSurface, clamped_knots, uniform_knots
from flexroad.tools.export import step
from flexroad.tools.export.georeference import Georeference
from tests.validators.opencascade import read_step

BOUNDS = (295450.0, 5629200.0, 295800.0, 5629550.0)
CORE = (295500.0, 5629250.0, 295750.0, 5629500.0)
PLACE = Georeference("EPSG:25832", (295000.0, 5629100.0, 0.0), "EPSG:7837")
"""What all tiles of a run are relative to."""
WRITTEN = datetime(2026, 5, 4, 3, 2, 1)


def surface(weights: bool, crs: str = "EPSG:25832") -> NurbsSurface:
    rng = np.random.default_rng(7)
    n, m = 14, 12
    w = np.exp(rng.uniform(-1, 1, (m, n))) if weights else np.ones((m, n))
    knots = (
        (clamped_knots(n, 3), clamped_knots(m, 3))
        if weights
        else (uniform_knots(0, n - 3, 3), uniform_knots(0, m - 3, 3))
    )
    return NurbsSurface(
        crs, BOUNDS, (3, 3), *knots, w * rng.normal(0, 2, (m, n)), w, 150.25, (295500.0, 5629250.0)
    )


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
    text = step.encode(
        surface(False, wkt), CORE, "tîle 'a'\\b", WRITTEN, Georeference(wkt, (0.0, 0.0, 0.0))
    ).decode("ascii")
    (description,) = re.findall(r"FILE_DESCRIPTION\((.*),'2;1'\);", text)
    assert max(map(len, re.findall(r"'((?:[^']|'')*)'", description))) <= 256
    assert r"PRODUCT('t\X4\000000EE\X0\le ''a''\\b'," in text


def test_encode_equal_surfaces_give_equal_bytes():
    assert encoded(True) == encoded(True)
