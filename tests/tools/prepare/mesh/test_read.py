"""Meshes are read without loss; invalid files are an error of one line."""

import json
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from flexroad.catalog.grid import Grid
from flexroad.tasks.errors import TaskError
from flexroad.tasks.products import glb
from flexroad.tasks.types import Mesh
from flexroad.tools.prepare.mesh.read import read_mesh
from flexroad.tools.prepare.mesh.sample import orthophoto

CRS = "EPSG:32617"
ZERO = (552_208.0, 4_114_742.0, 0.0)
PLACED = {"crs": CRS, "offset": ZERO}
GRID = Grid(CRS, ZERO[0], ZERO[1] + 12, 1.0, 16, 12)
CORNERS = np.array([(0, 0, 600.25), (16, 0, 601.0), (16, 12, 602.5), (0, 12, 600.75)])
FACES = np.array([[0, 1, 2], [0, 2, 3]])
UV = np.array([(0, 0), (1, 0), (1, 1), (0, 1)])
OBJ = "v 0 0 600.25\nv 16 0 601\nv 16 12 602.5\nv 0 12 600.75\n"
TEXTURES = "vt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"


@pytest.fixture
def texture():
    return np.random.default_rng(1).integers(0, 256, (12, 16, 3), dtype=np.uint8)


def textured(texture):
    visual = trimesh.visual.TextureVisuals(uv=UV, image=Image.fromarray(texture))
    return trimesh.Trimesh(CORNERS, FACES, visual=visual, process=False)


def write_obj(folder, texture, faces="usemtl m\nf 1/1 2/2 3/3\nf 1/1 3/3 4/4\n", head="mtllib m.mtl\n"):
    (folder / "m.obj").write_text(head + OBJ + TEXTURES + faces)
    (folder / "m.mtl").write_text("newmtl m\nKd 1 1 1\nmap_Kd m.png\n")
    Image.fromarray(texture).save(folder / "m.png")
    return folder / "m.obj"


def write_ply(folder, texture, kind="double"):
    """Write texture coordinates per corner, as photogrammetry software does."""
    Image.fromarray(texture).save(folder / "m.png")
    lines = ["ply", "format ascii 1.0", "comment TextureFile m.png", "element vertex 4"]
    lines += [f"property {kind} {axis}" for axis in "xyz"]
    lines += [
        "element face 2",
        "property list uchar int vertex_indices",
        "property list uchar float texcoord",
    ]
    lines += ["end_header", *(" ".join(map(str, v)) for v in CORNERS)]
    for face in FACES:
        lines.append(" ".join(map(str, [3, *face, 6, *UV[face].ravel()])))
    (folder / "m.ply").write_text("\n".join(lines) + "\n")
    return folder / "m.ply"


def write_glb(folder, texture):
    mesh = textured(texture)
    mesh.vertices = CORNERS[:, [0, 2, 1]] * (1, 1, -1)
    (folder / "m.glb").write_bytes(trimesh.Scene(mesh).export(file_type="glb"))
    return folder / "m.glb"


def check_vertices(mesh, atol=1e-9):
    corners = mesh.vertices[mesh.faces] - ZERO
    np.testing.assert_allclose(corners, CORNERS[FACES], atol=atol)


@pytest.mark.parametrize("write", [write_obj, write_ply, write_glb])
def test_read_mesh_formats_give_the_same_mesh_and_orthophoto(write, texture, tmp_path):
    mesh = read_mesh(write(tmp_path, texture), **PLACED)
    check_vertices(mesh)
    assert mesh.crs == CRS
    assert mesh.notes == ()
    photo = orthophoto(mesh, GRID)
    assert np.abs(np.moveaxis(photo.colour, 0, -1).astype(int) - texture).max() <= 1


def test_read_mesh_two_materials_keep_their_textures(tmp_path, texture):
    red = np.full((4, 4, 3), (200, 10, 10), np.uint8)
    path = write_obj(tmp_path, texture, "usemtl m\nf 1/1 2/2 3/3\nusemtl red\nf 1/1 3/3 4/4\n")
    with (tmp_path / "m.mtl").open("a") as file:
        file.write("newmtl red\nmap_Kd red.png\n")
    Image.fromarray(red).save(tmp_path / "red.png")
    mesh = read_mesh(path, **PLACED)
    assert len(mesh.textures) == 2
    colour = np.moveaxis(orthophoto(mesh, GRID).colour, 0, -1)
    assert tuple(colour[0, 0]) == (200, 10, 10)
    assert np.abs(colour[11, 15].astype(int) - texture[11, 15]).max() <= 1


def test_read_mesh_shared_corner_keeps_several_texture_coordinates(tmp_path, texture):
    """The second face has the texture upside down, at corners it shares with the first."""
    mesh = read_mesh(write_obj(tmp_path, texture, "usemtl m\nf 1/1 2/2 3/3\nf 1/3 3/1 4/2\n"), **PLACED)
    check_vertices(mesh)
    np.testing.assert_allclose(mesh.uv, [UV[[0, 1, 2]], UV[[2, 0, 1]]])


def test_read_mesh_large_coordinates_keep_all_digits(tmp_path, texture):
    far = "".join(f"v {ZERO[0] + x + 0.1234567} {ZERO[1] + y + 0.7654321} {z}\n" for x, y, z in CORNERS)
    path = write_obj(tmp_path, texture)
    path.write_text(path.read_text().replace(OBJ, far))
    mesh = read_mesh(path, crs=CRS)
    np.testing.assert_allclose(
        mesh.vertices[mesh.faces], CORNERS[FACES] + (ZERO[0] + 0.1234567, ZERO[1] + 0.7654321, 0), atol=1e-8
    )


def test_read_mesh_reads_colours_of_vertices_and_materials(tmp_path):
    colours = np.array([(250, 0, 0), (0, 250, 0), (0, 0, 250), (90, 90, 90)], np.uint8)
    trimesh.Trimesh(CORNERS, FACES, vertex_colors=colours, process=False).export(tmp_path / "v.ply")
    mesh = read_mesh(tmp_path / "v.ply", **PLACED)
    assert np.array_equal(mesh.colours, colours[FACES])
    (tmp_path / "k.obj").write_text("mtllib k.mtl\n" + OBJ + "usemtl k\nf 1 2 3\nf 1 3 4\n")
    (tmp_path / "k.mtl").write_text("newmtl k\nKd 1 0 0.2\n")
    assert (read_mesh(tmp_path / "k.obj", **PLACED).colours == (255, 0, 51)).all()


def test_read_mesh_of_own_glb_uses_its_georeference(tmp_path):
    mesh = Mesh(
        CRS,
        (552_000.0, 4_114_500.0, 590.0),
        np.add(CORNERS, (208, 242, -590)),
        FACES.astype(np.int32),
        np.array([True, False]),
    )
    (tmp_path / "t.glb").write_bytes(glb.encode(mesh, (550_000.0, 4_114_000.0, 590.0)))
    back = read_mesh(tmp_path / "t.glb")
    assert back.crs == CRS
    check_vertices(back, atol=1e-3)
    # The colours of the viewer, within one step: the file stores 8 bits in linear light.
    np.testing.assert_allclose(back.colours[:, 0], [(0x3A, 0x3A, 0x40), (0xC4, 0xBE, 0xAE)], atol=1)


def test_read_mesh_wrong_upward_axis_is_an_error(tmp_path, texture):
    path = write_glb(tmp_path, texture)
    check_vertices(read_mesh(path, up="y", **PLACED))
    with pytest.raises(TaskError, match="m.glb has a wrong upward axis.*--up y"):
        read_mesh(path, up="z", **PLACED)


def test_read_mesh_inside_out_gives_a_note(tmp_path, texture):
    path = write_obj(tmp_path, texture, "usemtl m\nf 3/3 2/2 1/1\nf 4/4 3/3 1/1\n")
    note = "m.obj is inside out: most faces point down; it is used unchanged"
    assert read_mesh(path, **PLACED).notes == (note,)


MODEL_METADATA = """<?xml version="1.0" encoding="utf-8"?>
<ModelMetadata version="1">
\t<SRS>{}</SRS>
\t<SRSOrigin>{}</SRSOrigin>
</ModelMetadata>
"""
SIDECARS = {
    "data_meta.json": (
        json.dumps({"reference_utm": {"zone": [17, "N"], "offset": [552208, 4114742, -5]}}),
        -5,
    ),
    "coords.txt": ("WGS84 UTM 17N\n552208 4114742\n1 2 3\n", 0),
    "odm_georeferencing/coords.txt": ("EPSG:32617\n552208 4114742\n", 0),
    "metadata.xml": (MODEL_METADATA.format("EPSG:32617", "552208,4114742,7"), 7),
}


@pytest.mark.parametrize("name", SIDECARS)
@pytest.mark.parametrize("above", [0, 1, 2])
def test_read_mesh_uses_sidecar_up_to_two_folders_above(name, above, tmp_path, texture):
    text, up = SIDECARS[name]
    folder = tmp_path.joinpath(*["x"] * above)
    folder.mkdir(parents=True, exist_ok=True)
    (tmp_path / name).parent.mkdir(exist_ok=True)
    (tmp_path / name).write_text(text)
    mesh = read_mesh(write_obj(folder, texture))
    assert mesh.crs == CRS
    np.testing.assert_allclose(mesh.vertices[mesh.faces] - ZERO - (0, 0, up), CORNERS[FACES], atol=1e-9)
    # Arguments take precedence over the sidecar.
    assert read_mesh(folder / "m.obj", crs="EPSG:25832", offset=(0, 0, 0)).crs == "EPSG:25832"


def test_read_mesh_prj_gives_only_the_crs(tmp_path, texture):
    path = write_obj(tmp_path, texture)
    (tmp_path / "m.prj").write_text("+proj=utm +zone=17 +datum=WGS84 +units=m +no_defs\n")
    check_vertices(read_mesh(path, offset=ZERO))
    with pytest.raises(TaskError, match="m.obj has no georeference.*--offset"):
        read_mesh(path)


def bare_glb(folder, texture):
    mesh = textured(texture)
    mesh.vertices = CORNERS[:, [0, 2, 1]] * (1, 1, -1)
    mesh.visual = trimesh.visual.TextureVisuals(uv=UV, material=trimesh.visual.material.PBRMaterial())
    (folder / "m.glb").write_bytes(trimesh.Scene(mesh).export(file_type="glb"))
    return folder / "m.glb"


def obj(**options):
    return lambda folder, texture: write_obj(folder, texture, **options)


def cut_short(path):
    path.write_bytes(path.read_bytes()[:300])


GONE = Path.unlink
BARE_FACES = "f 1 2 3\nf 1 3 4\n"
NO_COLOURS = [
    (write_obj, {"m.png": GONE}, "m.obj needs the texture .*m.png, which does not exist.*--no-dop"),
    (write_ply, {"m.png": GONE}, "m.ply needs the texture .*m.png, which does not exist.*--no-dop"),
    (write_obj, {"m.png": cut_short}, "the texture .*m.png of .*m.obj cannot be read"),
    (write_obj, {"m.mtl": GONE}, "m.obj needs the material file m.mtl, which is not beside it.*--no-dop"),
    (obj(faces="usemtl m\n" + BARE_FACES), {}, "m.obj has a texture but no texture coordinates.*--no-dop"),
    (obj(head="", faces=BARE_FACES), {}, "m.obj has no colours.*--no-dop"),
]
"""Meshes that can be read without colours: how they are written, what is done to a file, and the error."""
SIDECAR_FAULTS = [
    ("data_meta.json", '{"reference_utm": {"offset": [1, 2, 3]}}', " has no reference_utm"),
    ("coords.txt", "WGS84 UTM 17N\n", " has no CRS in its first line and an offset"),
    (
        "metadata.xml",
        MODEL_METADATA.format("ENU:37.2,-80.4", "0,0,0"),
        " has no SRS like .*ENU:37.2,-80.4.*--crs and --offset",
    ),
    (
        "metadata.xml",
        MODEL_METADATA.format("EPSG:32617", "552208,4114742"),
        " has no SRS like .* with an SRSOrigin of three numbers",
    ),
]
NO_NUMBER = obj(head="mtllib m.mtl\nv nan 0 0\n", faces="usemtl m\nf 1/1 2/2 3/3\n")
BAD = [
    *((write, changes, PLACED, message) for write, changes, message in NO_COLOURS),
    *((write_obj, {name: text}, {}, name + message) for name, text, message in SIDECAR_FAULTS),
    (bare_glb, {}, PLACED, "m.glb has no colours"),
    (write_obj, {}, {}, "m.obj has no georeference.*--crs EPSG:.*--offset"),
    (write_obj, {}, {"crs": CRS}, "m.obj has no georeference"),
    (write_obj, {}, {"crs": "EPSG:nothing", "offset": ZERO}, "m.obj: unknown CRS 'EPSG:nothing'"),
    (obj(faces=""), {}, PLACED, "m.obj has no faces"),
    (obj(faces="usemtl m\nf 1/1 2/2 2/2\n"), {}, PLACED, "m.obj has faces but no area"),
    (NO_NUMBER, {}, PLACED, "m.obj has faces with missing or non-finite corners"),
    (write_glb, {"m.glb": cut_short}, PLACED, "m.glb cannot be read as a mesh"),
    (lambda folder, _: folder / "gone.obj", {}, PLACED, "gone.obj does not exist"),
    (lambda folder, _: folder / "m.fbx", {"m.fbx": "x"}, PLACED, "m.fbx is not a mesh of a supported format"),
]


def written(write, changes, folder, texture):
    """Write a mesh; then write texts to files of its folder, or change them."""
    path = write(folder, texture)
    for name, change in changes.items():
        if isinstance(change, str):
            (folder / name).write_text(change)
        else:
            change(folder / name)
    return path


@pytest.mark.parametrize(("write", "changes", "options", "message"), BAD)
def test_read_mesh_invalid_input_is_one_line_with_file_and_remedy(
    write, changes, options, message, tmp_path, texture
):
    path = written(write, changes, tmp_path, texture)
    with pytest.raises(TaskError, match=message) as caught:
        read_mesh(path, **options)
    assert "\n" not in str(caught.value)
    assert caught.value.file


@pytest.mark.parametrize(("write", "changes", "message"), NO_COLOURS)
def test_read_mesh_without_colours_ignores_missing_textures(write, changes, message, tmp_path, texture):
    mesh = read_mesh(written(write, changes, tmp_path, texture), **PLACED, colours=False)
    check_vertices(mesh)
    assert not mesh.coloured
