import io
import json
import struct

import numpy as np
import pytest
import trimesh

from flexroad.tasks.export import glb
from flexroad.tasks.types import Mesh

ORIGIN = (295500.0, 5629250.0, 150.0)
RUN_ORIGIN = (295000.0, 5629000.0, 100.0)


def hills(n: int = 21, road_columns: int = 4) -> Mesh:
    """Return a 10 m square of hills whose western columns of faces are road."""
    x, y = np.meshgrid(np.linspace(0, 10, n), np.linspace(0, 10, n))
    z = 3.2 + np.sin(x / 3) + 0.1 * y
    i = np.arange(n * n).reshape(n, n)
    a, b, c, d = i[:-1, :-1].ravel(), i[:-1, 1:].ravel(), i[1:, 1:].ravel(), i[1:, :-1].ravel()
    faces = np.concatenate([np.c_[a, b, c], np.c_[a, c, d]]).astype(np.int32)
    vertices = np.c_[x.ravel(), y.ravel(), z.ravel()]
    road = vertices[faces].mean(axis=1)[:, 0] < road_columns * 10 / (n - 1)
    return Mesh("EPSG:25832", ORIGIN, vertices, faces, road)


def gltf_json(data: bytes) -> dict:
    """Return the JSON chunk, parsed by the GLB layout of the glTF standard."""
    magic, version, length, json_length, kind = struct.unpack("<4sIII4s", data[:20])
    assert (magic, version, length, kind) == (b"glTF", 2, len(data), b"JSON")
    return json.loads(data[20 : 20 + json_length])


def read(data: bytes) -> trimesh.Scene:
    return trimesh.load_scene(io.BytesIO(data), file_type="glb", process=False)


def placed(scene: trimesh.Scene, node: str) -> trimesh.Trimesh:
    transform, geometry = scene.graph[node]
    return scene.geometry[geometry].copy().apply_transform(transform)


def to_world(points: np.ndarray) -> np.ndarray:
    """Convert glTF's axes to easting, northing, height."""
    x, y, z = points.T
    return np.c_[x, -z, y] + RUN_ORIGIN


def test_encode_reads_back_within_float32():
    mesh = hills()
    scene = read(glb.encode(mesh, RUN_ORIGIN))
    for node, faces in (("road", mesh.road), ("terrain", ~mesh.road)):
        corners = to_world(placed(scene, node).triangles.reshape(-1, 3))
        truth = (mesh.vertices + ORIGIN)[mesh.faces[faces]].reshape(-1, 3)
        np.testing.assert_allclose(corners, truth, rtol=0, atol=2e-6)


def test_encode_vertices_are_local_and_tile_node_moves_them():
    data = glb.encode(hills(), RUN_ORIGIN)
    nodes = {node["name"]: node for node in gltf_json(data)["nodes"]}
    assert set(nodes) == {"tile", "road", "terrain"}
    assert np.reshape(nodes["tile"]["matrix"], (4, 4))[3].tolist() == [500.0, 50.0, -250.0, 1.0]
    assert "matrix" not in nodes["road"]
    children = [gltf_json(data)["nodes"][i]["name"] for i in nodes["tile"]["children"]]
    assert sorted(children) == ["road", "terrain"]
    positions = [a for a in gltf_json(data)["accessors"] if a["type"] == "VEC3"]
    assert max(np.abs([*a["min"], *a["max"]]).max() for a in positions) <= 10.0


def test_encode_extras_have_georeference():
    extras = gltf_json(glb.encode(hills(), RUN_ORIGIN))["scenes"][0]["extras"]
    assert extras["crs"] == "EPSG:25832"
    assert extras["origin"] == list(ORIGIN)
    assert extras["run_origin"] == list(RUN_ORIGIN)


def test_encode_north_is_minus_z_and_up_is_y():
    spike = np.array([[0, 0, 0], [1, 0, 0], [0, 7, 0], [0, 0, 3]], float)
    mesh = Mesh("EPSG:25832", ORIGIN, spike, np.array([[0, 1, 2], [0, 1, 3]], np.int32), np.zeros(2, bool))
    terrain = placed(read(glb.encode(mesh, ORIGIN)), "terrain")
    np.testing.assert_allclose(terrain.bounds, [[0, 0, -7], [1, 3, 0]])


def test_encode_faces_and_normals_point_up():
    scene = read(glb.encode(hills(), RUN_ORIGIN))
    for node in ("road", "terrain"):
        part = placed(scene, node)
        assert (part.face_normals[:, 1] > 0).all()
        assert (part.vertex_normals[:, 1] > 0).all()


def test_encode_shading_has_no_seam_at_road_edge():
    mesh = hills()
    scene = read(glb.encode(mesh, RUN_ORIGIN))
    edge = 2.0
    for node in ("road", "terrain"):
        part = scene.geometry[scene.graph[node][1]]
        at_edge = part.vertices[:, 0] == edge
        slope_x, slope_y = np.cos(edge / 3) / 3, 0.1
        truth = np.array([-slope_x, 1.0, slope_y]) / np.hypot(1, np.hypot(slope_x, slope_y))
        inner = at_edge & (part.vertices[:, 2] < -0.1) & (part.vertices[:, 2] > -9.9)
        assert inner.sum() == 19
        np.testing.assert_allclose(part.vertex_normals[inner], np.tile(truth, (19, 1)), atol=5e-3)


@pytest.mark.parametrize(("columns", "nodes"), [(0, {"terrain"}), (20, {"road"})])
def test_encode_class_without_faces_has_no_node(columns, nodes):
    scene = read(glb.encode(hills(road_columns=columns), RUN_ORIGIN))
    assert set(scene.graph.nodes_geometry) == nodes


def test_encode_equal_meshes_give_equal_bytes():
    assert glb.encode(hills(), RUN_ORIGIN) == glb.encode(hills(), RUN_ORIGIN)


def test_encode_keeps_non_ascii_wkt():
    mesh = hills(3)
    named = Mesh('PROJCRS["Réunion"]', mesh.origin, mesh.vertices, mesh.faces, mesh.road)
    data = glb.encode(named, RUN_ORIGIN)
    assert gltf_json(data)["scenes"][0]["extras"]["crs"] == 'PROJCRS["Réunion"]'
