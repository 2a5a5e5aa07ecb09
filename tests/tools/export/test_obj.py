import numpy as np
import pytest
import trimesh
from PIL import Image

from flexroad.tasks.types import Mesh
from flexroad.tools.export import obj
from flexroad.tools.export.georeference import Georeference
from tests.builders import make_mesh
from tests.crossing import Crossing

PLACE = Georeference("EPSG:25832", (295400.0, 5629200.0, 0.0), "EPSG:7837")
"""What all tiles of a run are relative to."""
PHOTO = (295500.0, 5629248.0, 295512.0, 5629260.0)


def loaded(folder, mesh: Mesh, textured: bool = False) -> dict[str, trimesh.Trimesh]:
    """Return the meshes of both materials as trimesh reads them from the files."""
    (folder / "tile.obj").write_bytes(obj.encode(mesh, "tile.mtl", PLACE, PHOTO if textured else None))
    (folder / "tile.mtl").write_bytes(obj.encode_materials("tile.jpg" if textured else None))
    if textured:
        Image.new("RGB", (24, 24), (10, 200, 30)).save(folder / "tile.jpg")
    scene = trimesh.load_scene(folder / "tile.obj", process=False)
    return {part.visual.material.name: part for part in scene.geometry.values()}


@pytest.mark.parametrize("textured", [False, True])
def test_encode_is_read_by_trimesh(tmp_path, textured):
    mesh = make_mesh()
    parts = loaded(tmp_path, mesh, textured)
    assert set(parts) == {"road", "terrain"}
    for name, faces in (("road", mesh.road), ("terrain", ~mesh.road)):
        truth = np.add(mesh.vertices, (100, 50, 150))[mesh.faces[faces]]
        np.testing.assert_allclose(parts[name].triangles, truth, rtol=0, atol=0.6e-4)
        assert (parts[name].face_normals[:, 2] > 0).all()


def test_encode_texture_coordinates_are_places_in_the_photo(tmp_path):
    for part in loaded(tmp_path, make_mesh(), textured=True).values():
        x, y, _ = part.vertices.T
        np.testing.assert_allclose(part.visual.uv, np.c_[(x - 100) / 12, (y - 48) / 12], atol=1e-5)
        assert part.visual.material.image.size == (24, 24)


def test_materials_have_colours_or_the_texture():
    plain = obj.encode_materials().decode()
    assert plain.count("newmtl") == 2
    assert "map_Kd" not in plain
    assert obj.encode_materials("a.jpg").decode().count("map_Kd a.jpg\n") == 2


def test_encode_comments_have_the_place():
    lines = obj.encode(make_mesh(), "tile.mtl", PLACE).decode("ascii").splitlines()
    assert lines[:5] == [
        "# origin 295400 5629200 0 (easting northing height, m)",
        "# crs EPSG:25832",
        "# vertical crs EPSG:7837",
        "# axes x east, y north, relative to origin; z height; metres",
        "mtllib tile.mtl",
    ]


@pytest.mark.parametrize(("road_from", "group"), [(-1, "road"), (99, "terrain")])
def test_encode_class_without_faces_has_no_group(road_from, group):
    lines = obj.encode(make_mesh(road_from=road_from), "tile.mtl", PLACE).decode().splitlines()
    assert [line for line in lines if line.startswith("g ")] == [f"g {group}"]


def test_encode_deck_is_a_group_with_the_material_of_roads():
    mesh, _ = Crossing((40.0, 30.0)).mesh()
    text = obj.encode(mesh, "tile.mtl", PLACE).decode()
    groups = {part.split()[0]: part.splitlines() for part in text.split("\ng ")[1:]}
    assert list(groups) == ["road", "terrain", "level_1"]
    assert groups["level_1"][1] == "usemtl road"
    faces = [[int(k) - 1 for k in line.split()[1:]] for line in groups["level_1"][2:]]
    np.testing.assert_array_equal(faces, mesh.faces[mesh.level == 1])
    assert sum(len(lines) - 2 for lines in groups.values()) == len(mesh.faces)
