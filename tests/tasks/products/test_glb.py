import io
import json
import struct
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from PIL import Image
from scipy.ndimage import map_coordinates

from flexroad.catalog import Grid
from flexroad.tasks.meshing.normals import mesh_normals
from flexroad.tasks.products import glb
from flexroad.tasks.types import Mesh, Orthophoto
from tests.builders import make_surface
from tests.crossing import DECK_M, GROUND_M, RISE, WEST, Crossing
from tests.validators.gltf import gltf_issues

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
    data = glb.encode(hills(), RUN_ORIGIN, name="295500_5629250")
    nodes = {node["name"]: node for node in gltf_json(data)["nodes"]}
    tile = nodes["295500_5629250"]
    assert np.reshape(tile["matrix"], (4, 4))[3].tolist() == [500.0, 50.0, -250.0, 1.0]
    assert "matrix" not in nodes["road"]
    children = [gltf_json(data)["nodes"][i]["name"] for i in tile["children"]]
    assert sorted(children) == ["road", "terrain"]
    positions = [a for a in gltf_json(data)["accessors"] if a["type"] == "VEC3"]
    assert max(np.abs([*a["min"], *a["max"]]).max() for a in positions) <= 10.0


def test_encode_photos_are_unlit_and_plain_colours_are_not():
    """A lit photo is darker the lower the sun of the viewer."""
    photo = glb.texture(colour_by_place(0.5), 85)
    lit, unlit = (gltf_json(glb.encode(hills(), RUN_ORIGIN, texture)) for texture in (None, photo))
    assert "extensionsUsed" not in lit
    assert unlit["extensionsUsed"] == ["KHR_materials_unlit"]
    for material in unlit["materials"]:
        assert material["extensions"] == {"KHR_materials_unlit": {}}
    assert not any("extensions" in material for material in lit["materials"])


def test_encode_extras_have_georeference():
    mesh = replace(hills(3), crs='PROJCRS["Réunion"]')
    extras = gltf_json(glb.encode(mesh, RUN_ORIGIN))["scenes"][0]["extras"]
    assert extras["crs"] == 'PROJCRS["Réunion"]'
    assert extras["origin"] == list(ORIGIN)
    assert extras["run_origin"] == list(RUN_ORIGIN)


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


def test_encode_normals_on_the_border_are_those_of_the_surface():
    mesh = hills()
    west, south, _ = ORIGIN
    surface = make_surface((5, 5), bounds=(west, south, west + 10.0, south + 10.0))
    normals, faces_alone = (mesh_normals(mesh, each) for each in (surface, None))
    x, y = mesh.vertices[:, 0], mesh.vertices[:, 1]
    border = (x == 0) | (x == 10) | (y == 0) | (y == 10)
    truth = surface.normal(x + west, y + south)
    np.testing.assert_array_equal(normals, np.where(border[:, None], truth, faces_alone))
    written = attribute(glb.encode(mesh, RUN_ORIGIN, normals=normals), "road", "NORMAL")
    used, _ = mesh.part(mesh.road)
    east, north, up = normals[used].T
    np.testing.assert_allclose(written, np.c_[east, up, -north], atol=1e-6)


@pytest.mark.parametrize(("columns", "nodes"), [(0, {"terrain"}), (20, {"road"})])
def test_encode_class_without_faces_has_no_node(columns, nodes):
    scene = read(glb.encode(hills(road_columns=columns), RUN_ORIGIN))
    assert set(scene.graph.nodes_geometry) == nodes


def colour_by_place(cell: float, size: float = 12.0) -> Orthophoto:
    """Return a photo of the hills and 2 m more in the east and south: red is easting, green is northing."""
    grid = Grid("EPSG:25832", ORIGIN[0], ORIGIN[1] + 10, cell, round(size / cell), round(size / cell))
    red = (grid.eastings - grid.west) / size * 255
    green = (grid.northings - grid.south) / size * 255
    colour = np.stack([*np.broadcast_arrays(red, green[:, None]), np.full(grid.shape, 128.0)])
    return Orthophoto(grid, colour.round().astype(np.uint8), np.ones(grid.shape, bool))


def view(data: bytes, index: int) -> bytes:
    """Return the bytes of a buffer view."""
    content = gltf_json(data)["bufferViews"][index]
    start = data.index(b"BIN\0", 20) + 4 + content["byteOffset"]
    return data[start : start + content["byteLength"]]


def attribute(data: bytes, node: str, name: str) -> np.ndarray:
    """Return an attribute of a node's vertices as the file has it, ``(V, 2)`` or ``(V, 3)``."""
    tree = gltf_json(data)
    (mesh,) = [mesh for mesh in tree["meshes"] if mesh["name"] == node]
    accessor = tree["accessors"][mesh["primitives"][0]["attributes"][name]]
    assert accessor["componentType"] == 5126
    return np.frombuffer(view(data, accessor["bufferView"]), "<f4").reshape(accessor["count"], -1)


def image(data: bytes) -> np.ndarray:
    """Return the only image, ``(h, w, 3)``."""
    (only,) = gltf_json(data)["images"]
    assert only["mimeType"] == "image/jpeg"
    return np.asarray(Image.open(io.BytesIO(view(data, only["bufferView"]))), float)


def looked_up(texels: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """Return the colour at texture coordinates as glTF defines them: (0, 0) is the first texel's corner."""
    height, width, _ = texels.shape
    place = [uv[:, 1] * height - 0.5, uv[:, 0] * width - 0.5]
    bands = np.moveaxis(texels, -1, 0)
    return np.stack([map_coordinates(band, place, order=1, mode="nearest") for band in bands], axis=1)


@pytest.mark.parametrize("cell", [0.4, 0.6])
def test_encode_texture_colour_of_each_vertex_tells_its_place(cell):
    photo = colour_by_place(cell)
    data = glb.encode(hills(), RUN_ORIGIN, glb.texture(photo, 95))
    errors = []
    for node in ("road", "terrain"):
        x, _, z = attribute(data, node, "POSITION").T
        colour = looked_up(image(data), attribute(data, node, "TEXCOORD_0"))
        # The mesh starts 2 m north of the photo's south-west corner. Beyond the outermost texel centres
        # the colour is the border's.
        for band, place in ((0, x), (1, 2 - z)):
            errors.append(colour[:, band] / 255 * 12 - np.clip(place, cell / 2, 12 - cell / 2))
    assert max(np.abs(error).max() for error in errors) < cell
    # A shift by half a texel would show in the mean.
    assert max(abs(error.mean()) for error in errors) < 0.15 * cell


def test_encode_texture_keeps_positions_normals_and_faces():
    plain = glb.encode(hills(), RUN_ORIGIN)
    textured = glb.encode(hills(), RUN_ORIGIN, glb.texture(colour_by_place(0.5), 85))
    for node in ("road", "terrain"):
        for name in ("POSITION", "NORMAL"):
            np.testing.assert_array_equal(attribute(textured, node, name), attribute(plain, node, name))
        np.testing.assert_array_equal(placed(read(textured), node).faces, placed(read(plain), node).faces)


def test_encode_texture_is_one_clamped_image_of_both_nodes():
    texture = glb.texture(colour_by_place(0.5), 85)
    data = glb.encode(hills(), RUN_ORIGIN, texture)
    tree = gltf_json(data)
    assert view(data, tree["images"][0]["bufferView"]) == texture.jpeg
    assert [len(tree[name]) for name in ("images", "textures", "samplers")] == [1, 1, 1]
    assert (tree["samplers"][0]["wrapS"], tree["samplers"][0]["wrapT"]) == (33071, 33071)
    used = [tree["materials"][mesh["primitives"][0]["material"]] for mesh in tree["meshes"]]
    look = {"metallicFactor": 0.0, "roughnessFactor": 1.0, "baseColorTexture": {"index": 0}}
    assert [material["pbrMetallicRoughness"] for material in used] == [look, look]
    parts = read(data).geometry.values()
    assert [part.visual.material.baseColorTexture.size for part in parts] == [(24, 24), (24, 24)]


def test_texture_pixels_without_colour_take_the_mean_of_the_others():
    photo = colour_by_place(0.5)
    west = np.broadcast_to(photo.grid.eastings < ORIGIN[0] + 4, photo.grid.shape)
    black = replace(photo, colour=np.where(west, 0, photo.colour).astype(np.uint8), known=~west)
    texels = image(glb.encode(hills(), RUN_ORIGIN, glb.texture(black, 95)))
    mean = photo.colour[:, ~west].mean(axis=1)
    np.testing.assert_allclose(texels[:, :7].mean(axis=(0, 1)), mean, atol=3)


def test_texture_higher_quality_has_smaller_errors():
    noise = np.random.default_rng(0).integers(0, 255, (3, 24, 24)).astype(np.uint8)
    photo = replace(colour_by_place(0.5), colour=noise)
    images = [image(glb.encode(hills(), RUN_ORIGIN, glb.texture(photo, quality))) for quality in (20, 90)]
    errors = [np.abs(texels - np.moveaxis(noise, 0, -1)).mean() for texels in images]
    assert errors[1] < errors[0]


def test_encode_drops_vertices_without_faces():
    """Such a vertex has no normal, and glTF wants unit vectors."""
    mesh = hills(6, road_columns=2)
    lonely = replace(mesh, vertices=np.concatenate([mesh.vertices, [[5.0, 5.0, 5.0]]]))
    assert glb.encode(lonely, RUN_ORIGIN) == glb.encode(mesh, RUN_ORIGIN)
    for node in ("road", "terrain"):
        normals = attribute(glb.encode(lonely, RUN_ORIGIN), node, "NORMAL")
        np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-6)


def test_encoded_files_have_no_issue_by_the_khronos_validator(tmp_path):
    image = glb.texture(colour_by_place(0.5), 85)
    files = {
        "plain": glb.encode(hills(), RUN_ORIGIN),
        "road": glb.encode(hills(road_columns=20), RUN_ORIGIN),
        "textured": glb.encode(hills(), RUN_ORIGIN, image),
        "coarse": glb.encode_ground(
            hills().vertices,
            mesh_normals(hills()),
            hills().vertices[:, :2] / 10,
            hills().faces,
            image.jpeg,
            True,
        ),
        "deck": glb.encode(Crossing((40.0, 30.0)).mesh()[0], RUN_ORIGIN),
    }
    for name, data in files.items():
        (tmp_path / f"{name}.glb").write_bytes(data)
    assert gltf_issues(tmp_path.iterdir()) == []
    (tmp_path / "damaged.glb").write_bytes(files["plain"][:-4])
    assert gltf_issues([tmp_path / "damaged.glb"])


def test_encode_deck_is_a_node_of_its_own():
    crossing = Crossing((40.0, 30.0))
    mesh, surface = crossing.mesh()
    data = glb.encode(mesh, (WEST, mesh.origin[1], 0.0), normals=mesh_normals(mesh, surface))
    tree = gltf_json(data)
    names = {node["name"]: node for node in tree["nodes"]}
    level = names["level 1"]
    assert [tree["nodes"][k]["name"] for k in names["tile"]["children"]] == ["road", "terrain", "level 1"]
    (deck,) = (tree["nodes"][k] for k in level["children"])
    accessor = tree["meshes"][deck["mesh"]]["primitives"][0]["attributes"]["POSITION"]
    height = np.array([tree["accessors"][accessor][k][1] for k in ("min", "max")]) + mesh.origin[2]
    np.testing.assert_allclose(height, DECK_M + RISE * np.array([30, 50]), atol=1e-3)
    ground = mesh.at(0).vertices[:, 2].min() + mesh.origin[2]
    assert ground == pytest.approx(GROUND_M)


def test_encode_normals_of_deck_are_those_of_its_level():
    mesh, surface = Crossing((60.0, 30.0)).mesh()
    normals = mesh_normals(mesh, surface)
    deck = np.unique(mesh.faces[mesh.level == 1])
    plane = np.array([-RISE, 0.0, 1.0]) / np.hypot(RISE, 1.0)
    np.testing.assert_allclose(normals[deck], np.broadcast_to(plane, (len(deck), 3)), atol=2e-3)
