import json
import subprocess
from dataclasses import replace

import numpy as np
import pytest
from pyproj import CRS

from flexroad.tasks.errors import TaskError
from flexroad.tasks.types import Mesh
from flexroad.tools.export import cityjson
from tests import validators
from tests.builders import make_mesh as tile
from tests.crossing import Crossing

ORIGIN = (295000.0, 5629000.0, 100.0)


def written(meshes: list[Mesh], vertical: str | None = None) -> list[dict]:
    lines = [cityjson.header("EPSG:25832", ORIGIN, vertical)]
    lines += [cityjson.features(f"t{k}", mesh, ORIGIN, vertical) for k, mesh in enumerate(meshes)]
    return [json.loads(line) for line in b"".join(lines).splitlines()]


def read(lines: list[dict], kind: str) -> np.ndarray:
    """Return the triangles of all city objects of a kind, ``(F, 3, 3)``, by the CityJSON specification."""
    scale, shift = (np.array(lines[0]["transform"][key]) for key in ("scale", "translate"))
    found = []
    for line in lines[1:]:
        vertices = np.array(line["vertices"]) * scale + shift
        item = line["CityObjects"][line["id"]]
        if item["type"] == kind:
            (geometry,) = item["geometry"]
            assert all(len(rings) == 1 for rings in geometry["boundaries"])
            found.append(vertices[np.array(geometry["boundaries"])[:, 0]])
    return np.concatenate(found)


def test_write_reads_back_within_half_a_millimetre():
    meshes = [tile(0), tile(1)]
    lines = written(meshes)
    for kind, road in (("Road", True), ("TINRelief", False)):
        truth = np.concatenate([(m.vertices + m.origin)[m.faces[m.road == road]] for m in meshes])
        np.testing.assert_allclose(read(lines, kind), truth, rtol=0, atol=0.5e-3 + 1e-8)


@pytest.mark.parametrize(("number", "kind"), [(1, "Bridge"), (-1, "Tunnel")])
def test_write_deck_is_a_bridge_and_tunnel_a_tunnel(number, kind):
    mesh, _ = Crossing((40.0, 30.0), number=number).mesh()
    lines = written([mesh])
    deck = mesh.at(number)
    truth = (deck.vertices + deck.origin)[deck.faces]
    np.testing.assert_allclose(read(lines, kind), truth, rtol=0, atol=0.5e-3 + 1e-8)
    (item,) = (line["CityObjects"][line["id"]] for line in lines[1:] if line["id"] == f"t0-{kind.lower()}1")
    assert item["attributes"]["level"] == number
    assert item["geometry"][0]["semantics"]["surfaces"] == [{"type": "OuterFloorSurface"}]
    ground = mesh.at(0)
    faces = sum(len(read(lines, other)) for other in ("Road", "TINRelief"))
    assert faces == len(ground.faces)


@pytest.mark.slow
def test_write_read_by_cjio_has_all_tiles_at_their_places(tmp_path):
    meshes = [tile(0), tile(1), replace(Crossing((40.0, 30.0)).mesh()[0], origin=tile(0).origin)]
    lines = "".join(json.dumps(line) + "\n" for line in written(meshes))
    command = [validators.program("cjio"), "--suppress_msg", "stdin", "save", "city.json"]
    subprocess.run(command, cwd=tmp_path, input=lines, text=True, check=True)
    city = json.loads((tmp_path / "city.json").read_text())
    kinds = [item["type"] for item in city["CityObjects"].values()]
    assert (kinds.count("TINRelief"), kinds.count("Road")) == (2, 3)  # the second tile is all road
    assert kinds.count("Bridge") == 1
    transform = city["transform"]
    found = np.array(city["vertices"]) * transform["scale"] + transform["translate"]
    truth = np.concatenate([mesh.vertices + mesh.origin for mesh in meshes])
    for least in (np.min, np.max):
        np.testing.assert_allclose(least(found, axis=0), least(truth, axis=0), rtol=0, atol=0.5e-3 + 1e-8)


def test_header_has_version_transform_and_crs():
    assert json.loads(cityjson.header("EPSG:25832", ORIGIN)) == {
        "type": "CityJSON",
        "version": "2.0",
        "transform": {"scale": [0.001, 0.001, 0.001], "translate": list(ORIGIN)},
        "metadata": {"referenceSystem": "https://www.opengis.net/def/crs/EPSG/0/25832"},
        "CityObjects": {},
        "vertices": [],
    }


@pytest.mark.parametrize(("vertical", "code"), [("EPSG:5783", "5555"), ("EPSG:7837", "25832")])
def test_header_compound_crs_has_its_code_if_it_is_registered(vertical, code):
    head, *lines = written([tile()], vertical)
    assert head["metadata"]["referenceSystem"].endswith(f"/EPSG/0/{code}")
    for line in lines:
        assert line["CityObjects"][line["id"]]["attributes"] == {"tile": "t0", "verticalCRS": vertical}


def test_features_have_one_object_with_their_id_whole_vertices_and_the_geometry_of_their_kind():
    _, *lines = written([tile(0), tile(1, road_from=99)])
    assert [line["id"] for line in lines] == ["t0-road", "t0-tinrelief", "t1-tinrelief"]
    for line in lines:
        assert list(line["CityObjects"]) == [line["id"]]
        vertices = np.array(line["vertices"])
        assert vertices.dtype == np.int64
        assert len(np.unique(vertices, axis=0)) == len(vertices)
        (geometry,) = line["CityObjects"][line["id"]]["geometry"]
        np.testing.assert_array_equal(np.unique(geometry["boundaries"]), np.arange(len(vertices)))
        semantics = geometry.get("semantics")
        if line["id"] == "t0-road":
            assert geometry["type"] == "MultiSurface"
            assert semantics["surfaces"] == [{"type": "TrafficArea"}]
            assert semantics["values"] == [0] * len(geometry["boundaries"])
        else:
            assert (geometry["type"], semantics) == ("CompositeSurface", None)


def test_features_vertices_within_a_millimetre_are_one():
    mesh = tile(road_from=-1)
    vertices = mesh.vertices.copy()
    vertices[1] = vertices[0] + (2e-4, 0, 0)
    _, line = written([replace(mesh, vertices=vertices)])
    (geometry,) = line["CityObjects"]["t0-road"]["geometry"]
    assert len(line["vertices"]) == len(vertices) - 1
    corners = np.array(geometry["boundaries"])[:, 0]
    assert len(corners) == len(mesh.faces) - 1
    assert all(len(set(face)) == 3 for face in corners.tolist())


def test_header_crs_without_code_is_refused():
    local = CRS.from_proj4("+proj=tmerc +lat_0=50 +lon_0=6 +k=1 +units=m").to_wkt()
    with pytest.raises(TaskError, match="has none; choose another format"):
        cityjson.header(local, ORIGIN)
