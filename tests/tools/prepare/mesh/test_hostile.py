"""Meshes from others: only files of their folder are read, and damaged numbers are one line."""

import contextlib
import json
import os
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from flexroad.tasks import TaskError, memory
from flexroad.tools.prepare import images
from flexroad.tools.prepare.mesh.read import gltf_elements, read_mesh
from tests import fuzz

PLACED = {"crs": "EPSG:32617", "offset": (552_208.0, 4_114_742.0, 0.0)}
SIDE = 6


def read(path: Path) -> float:
    """Read a mesh, also in a process of its own."""
    return read_mesh(path, **PLACED).area


def surface(kind="texture") -> trimesh.Trimesh:
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(SIDE), np.arange(SIDE)))
    vertices = np.column_stack([x, y, np.sin(x)])
    corner = (np.arange(SIDE - 1)[:, None] * SIDE + np.arange(SIDE - 1)).ravel()
    low = np.stack([corner, corner + 1, corner + SIDE], 1)
    faces = np.concatenate([low, np.stack([corner + 1, corner + SIDE + 1, corner + SIDE], 1)])
    if kind == "colours":
        grey = np.full((len(x), 4), 200, np.uint8)
        return trimesh.Trimesh(vertices, faces, vertex_colors=grey, process=False)
    image = Image.new("RGB", (8, 8), (9, 99, 200))
    visual = trimesh.visual.TextureVisuals(uv=vertices[:, :2] / SIDE, image=image)
    return trimesh.Trimesh(vertices, faces, visual=visual, process=False)


def write(folder: Path, name: str) -> Path:
    mesh = surface("colours" if name.endswith("ply") else "texture")
    if name.endswith(("glb", "gltf")):
        mesh.vertices = mesh.vertices[:, [0, 2, 1]] * (1, 1, -1)
    folder.mkdir(exist_ok=True)
    mesh.export(folder / name, **({"encoding": "ascii"} if name.startswith("ascii") else {}))
    return folder / name


def fails(path: Path, match: str, **options) -> None:
    with pytest.raises(TaskError, match=match) as caught:
        read_mesh(path, **PLACED | options)
    assert "\n" not in str(caught.value)
    assert str(path) in str(caught.value)


def replaced(path: Path, *words: str) -> Path:
    text = path.read_text()
    for old, new in zip(words[::2], words[1::2], strict=True):
        assert old in text
        text = text.replace(old, new, 1)
    path.write_text(text)
    return path


@pytest.fixture
def outside(tmp_path) -> Path:
    """A texture beside the folder of the mesh."""
    Image.new("RGB", (4, 4)).save(tmp_path / "secret.png")
    (tmp_path / "secret.mtl").write_text("newmtl material_0\nKd 1 1 1\n")
    return tmp_path / "secret.png"


@pytest.mark.parametrize("name", ["../secret.png", "ABSOLUTE", "link.png", "..\\secret.png"])
def test_texture_outside_the_folder_raises(tmp_path, outside, name):
    path = write(tmp_path / "mesh", "m.obj")
    (path.parent / "link.png").symlink_to(outside)
    name = name.replace("ABSOLUTE", str(outside))
    replaced(path.with_name("material.mtl"), "map_Kd material_0.png", f"map_Kd {name}")
    fails(path, "needs the file .* which is not in its folder.*--no-dop")
    assert not read_mesh(path, **PLACED, colours=False).coloured
    ply = write(tmp_path / "mesh", "ascii.ply")
    replaced(ply, "element vertex", f"comment TextureFile {outside}\nelement vertex")
    fails(ply, "which is not in its folder")


def test_files_of_the_folder_and_below_are_read(tmp_path):
    assert read_mesh(write(tmp_path, "m.gltf"), **PLACED).coloured
    path = write(tmp_path / "mesh", "m.obj")
    (path.parent / "textures").mkdir()
    (path.parent / "material_0.png").rename(path.parent / "textures" / "a b.png")
    replaced(path.with_name("material.mtl"), "material_0.png", "textures/a b.png")
    assert read_mesh(path, **PLACED).coloured


def test_materials_outside_the_folder_raise(tmp_path, outside):
    path = replaced(write(tmp_path / "mesh", "m.obj"), "mtllib material.mtl", "mtllib ../secret.mtl")
    fails(path, "needs the file '../secret.mtl', which is not in its folder")
    # trimesh does not get them either.
    assert not read_mesh(path, **PLACED, colours=False).coloured


@pytest.mark.parametrize("kind", ["buffers", "images"])
def test_gltf_uri_outside_the_folder_raises(tmp_path, kind):
    path = write(tmp_path / "mesh", "m.gltf")
    header = json.loads(path.read_text())
    Image.new("RGB", (4, 4)).save(tmp_path / "secret.png")
    if kind == "images":
        header["images"] = [{"uri": "../secret.png"}] * len(header["images"])
    else:
        (path.parent / header["buffers"][0]["uri"]).rename(tmp_path / "secret.bin")
        header["buffers"][0]["uri"] = "../secret.bin"
    path.write_text(json.dumps(header))
    fails(path, "needs the file '../secret.*', which is not in its folder")


@pytest.mark.parametrize("corner", ["-40", "99", "2147483648", "4294967295", "99999999999999999999"])
@pytest.mark.parametrize("name", ["m.obj", "ascii.ply"])
def test_face_beyond_the_vertices_raises(tmp_path, name, corner):
    path = write(tmp_path, name)
    if name == "m.obj":
        replaced(path, "f 1/", f"f {corner}/")
    else:
        replaced(path, "\n3 0 1 6", f"\n3 0 1 {corner}")
    fails(path, "faces with corners .* vertices|cannot be read as a mesh|non-finite")


@pytest.mark.parametrize("number", ["1e30", "-1e300", "nan", "inf"])
@pytest.mark.parametrize("name", ["m.obj", "ascii.ply"])
def test_corner_that_is_no_place_raises(tmp_path, name, number):
    path = write(tmp_path, name)
    line = next(line for line in path.read_text().splitlines() if line.startswith(("v 0", "0.0")))
    replaced(path, line, line.replace("0.0", number, 1))
    fails(path, "non-finite corners, or beyond 1e\\+09|cannot be read as a mesh: ValueError")


def test_vertex_that_no_face_uses_may_be_anywhere(tmp_path):
    path = write(tmp_path, "m.obj")
    path.write_text(path.read_text().replace("f ", "v nan 1e300 0\nf ", 1))
    assert read_mesh(path, **PLACED).area == pytest.approx(surface().area, rel=1e-6)


@pytest.mark.parametrize("number", ["nan", "inf", "1e38"])
def test_texture_coordinate_that_is_no_number_raises(tmp_path, number):
    path = write(tmp_path, "m.obj")
    line = next(line for line in path.read_text().splitlines() if line.startswith("vt "))
    fails(replaced(path, line, f"vt {number} 0"), "texture coordinates that are not numbers")


@pytest.mark.parametrize("name", ["m.obj", "ascii.ply", "m.ply", "m.glb"])
@pytest.mark.parametrize("size", [0, 11, 150, -200])
def test_mesh_cut_short_is_one_line(tmp_path, name, size):
    path = write(tmp_path, name)
    path.write_bytes(path.read_bytes()[:size])
    with contextlib.suppress(TaskError):
        read_mesh(path, **PLACED)


@pytest.mark.parametrize("name", ["m.obj", "m.gltf"])
def test_texture_with_too_many_pixels_raises(tmp_path, monkeypatch, name):
    monkeypatch.setattr(images, "MOST_PIXELS", 20_000)
    path = write(tmp_path, name)
    if name == "m.gltf":
        header = json.loads(path.read_text())
        path.write_text(json.dumps(header | {"images": [{"uri": "material_0.png"}]}))
    Image.new("L", (150, 150)).save(tmp_path / "material_0.png")
    fails(path, "exceeds limit of 20000 pixels" if name == "m.obj" else "has no colours")


def test_textures_larger_than_memory_raise(tmp_path, monkeypatch):
    path = write(tmp_path, "m.obj")
    monkeypatch.setattr(memory, "limit", lambda: 100_000)
    Image.new("L", (1000, 1000)).save(path.with_name("material_0.png"))
    fails(path, "the texture .* would need about .* GiB of memory.*use smaller textures")


@pytest.mark.parametrize("kind", ["nodes", "accessors"])
def test_gltf_that_repeats_a_mesh_or_has_no_bytes_raises_before_it_is_built(tmp_path, monkeypatch, kind):
    path = write(tmp_path, "m.gltf")
    header = json.loads(path.read_text())
    if kind == "nodes":
        header["nodes"] += [next(node for node in header["nodes"] if "mesh" in node)] * 50_000
    else:
        header["accessors"].append({"componentType": 5126, "type": "MAT4", "count": 10**13})
    path.write_text(json.dumps(header))
    monkeypatch.setattr(memory, "limit", lambda: 2**30)
    fails(path, "elements would need about .* GiB of memory.*divide the mesh")


@pytest.mark.parametrize(
    ("nodes", "reason"),
    [
        ([{"children": [1]}, {"children": [0]}], "below themselves"),
        ([{"children": [0]}], "below themselves"),
        ([{"children": [2]}, {"children": [2]}, {}], "two parents"),
        ([{"children": [7]}], "do not exist"),
        ([{"children": [n + 1]} for n in range(500)] + [{}], "more than 100 levels"),
        ([{}] * 100_001, "more than 100,000 nodes"),
    ],
)
def test_gltf_nodes_that_are_no_trees_raise(tmp_path, nodes, reason):
    path = tmp_path / "m.gltf"
    path.write_text(json.dumps({"nodes": nodes}))
    with pytest.raises(ValueError, match=reason):
        gltf_elements(path)
    fails(path, reason)


def test_pipes_are_not_opened(tmp_path):
    path = write(tmp_path, "m.obj")
    for name in ("m.ply", "pipe.png", "x.prj"):
        os.mkfifo(tmp_path / name)
    fails(tmp_path / "m.ply", "is not a file")
    with pytest.raises(TaskError, match="has no georeference"):
        read_mesh(path)
    replaced(path.with_name("material.mtl"), "material_0.png", "pipe.png")
    fails(path, "pipe.png, which does not exist")


@pytest.mark.parametrize("offset", [(float("nan"), 0, 0), (1e300, 0, 0)])
def test_offset_that_is_no_place_raises(tmp_path, offset):
    fails(write(tmp_path, "m.obj"), "which is not a place; give --offset", offset=offset)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["m.obj", "ascii.ply", "m.ply", "m.glb"])
def test_mesh_damaged_at_random_raises_or_reads(tmp_path, name):
    path = write(tmp_path, name)
    fuzz.check(__name__, "read", fuzz.damaged(path.read_bytes(), 200, 1), path)
