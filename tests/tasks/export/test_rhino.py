import sys

import numpy as np
import pytest

from flexroad.tasks.errors import TaskError
from flexroad.tasks.export import rhino
from flexroad.tasks.georeference import Georeference
from flexroad.tasks.spline.surface import NurbsSurface, clamped_knots, uniform_knots
from flexroad.tasks.types import Mesh
from tests.crossing import Crossing

BOUNDS = (295450.0, 5629200.0, 295800.0, 5629550.0)
CORE = (295500.0, 5629250.0, 295750.0, 5629500.0)
PLACE = Georeference("EPSG:25832", (295000.0, 5629100.0, 0.0), "EPSG:7837")
"""What all tiles of a run are relative to."""


def surface(weights: bool) -> NurbsSurface:
    rng = np.random.default_rng(7)
    n, m = 14, 12
    w = np.exp(rng.uniform(-1, 1, (m, n))) if weights else np.ones((m, n))
    kind = clamped_knots if weights else (lambda points, p: uniform_knots(0, points - p, p))
    knots = kind(n, 3), kind(m, 3)
    origin = (BOUNDS[0], BOUNDS[1])
    return NurbsSurface("EPSG:25832", BOUNDS, (3, 3), *knots, w * rng.normal(0, 2, (m, n)), w, 150.25, origin)


def tile(road_east: float = 100.0) -> Mesh:
    """Return a 250 m square of hills whose west is road."""
    x, y = np.meshgrid(np.linspace(0, 250, 9), np.linspace(0, 250, 9))
    i = np.arange(81).reshape(9, 9)
    a, b, c, d = i[:-1, :-1].ravel(), i[:-1, 1:].ravel(), i[1:, 1:].ravel(), i[1:, :-1].ravel()
    faces = np.concatenate([np.c_[a, b, c], np.c_[a, c, d]]).astype(np.int32)
    vertices = np.c_[x.ravel(), y.ravel(), 3.123456 + np.sin(x.ravel() / 30)]
    road = vertices[faces].mean(axis=1)[:, 0] < road_east
    return Mesh("EPSG:25832", (CORE[0], CORE[1], 1500.0), vertices, faces, road)


def read(data: bytes):
    rhino3dm = pytest.importorskip("rhino3dm")
    model = rhino3dm.File3dm.FromByteArray(data)
    assert model.Settings.ModelUnitSystem == rhino3dm.UnitSystem.Meters
    names = [layer.Name for layer in model.Layers]
    return model, {names[item.Attributes.LayerIndex]: item.Geometry for item in model.Objects}


@pytest.mark.parametrize("weights", [False, True])
def test_encode_surface_read_back_equals_surface(weights):
    pytest.importorskip("rhino3dm")
    truth = surface(weights)
    _, found = read(rhino.encode(tile(), truth, CORE, PLACE))
    nurbs = found["surface"]
    assert nurbs.IsValid
    assert nurbs.IsRational == weights
    for u, v in [(0, 0), (1, 1), (0.5, 0.5), (0.123, 0.77), (0.9, 0.31), (1, 0)]:
        point = nurbs.PointAt(u, v)
        x, y, z = point.X, point.Y, point.Z
        np.testing.assert_allclose((x, y), (500 + 250 * u, 150 + 250 * v), atol=1e-9)
        np.testing.assert_allclose(
            z, truth.height(PLACE.origin[0] + x, PLACE.origin[1] + y), rtol=0, atol=3e-9
        )


def test_encode_meshes_read_back_are_exact():
    pytest.importorskip("rhino3dm")
    mesh = tile()
    _, found = read(rhino.encode(mesh, None, CORE, PLACE))
    assert set(found) == {"road", "terrain"}
    for name, faces in (("road", mesh.road), ("terrain", ~mesh.road)):
        part = found[name]
        points = np.array([(p.X, p.Y, p.Z) for p in map(part.Vertices.Point3dAt, range(len(part.Vertices)))])
        corners = np.array([part.Faces[k][:3] for k in range(len(part.Faces))])
        truth = (mesh.vertices + np.array([500, 150, 1500]))[mesh.faces[faces]]
        np.testing.assert_array_equal(points[corners], truth)
        assert part.IsValid


def test_encode_deck_has_a_layer_of_its_own():
    pytest.importorskip("rhino3dm")
    mesh, _ = Crossing((40.0, 30.0)).mesh()
    _, found = read(rhino.encode(mesh, None, CORE, PLACE))
    faces = {"road": mesh.road & (mesh.level == 0), "terrain": ~mesh.road, "level 1": mesh.level == 1}
    assert {name: len(part.Faces) for name, part in found.items()} == {k: v.sum() for k, v in faces.items()}


def test_encode_document_has_place_and_layers():
    pytest.importorskip("rhino3dm")
    model, _ = read(rhino.encode(tile(), None, CORE, PLACE, {"beyond_survey_m2": "7"}))
    assert [layer.Name for layer in model.Layers] == ["surface", "road", "terrain"]
    texts = {model.Strings[k][0]: model.Strings[k][1] for k in range(len(model.Strings))}
    assert texts == {
        "crs": "EPSG:25832",
        "vertical_crs": "EPSG:7837",
        "origin": "295000 5629100 0",
        "axes": rhino.AXES,
        "beyond_survey_m2": "7",
    }


def test_encode_without_library_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "rhino3dm", None)
    with pytest.raises(TaskError, match=r"3DM files need rhino3dm: pip install 'flexroad\[export\]'"):
        rhino.encode(tile(), None, CORE, PLACE)
