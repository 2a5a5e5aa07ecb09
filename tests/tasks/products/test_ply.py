import io

import numpy as np
import pytest
import pyvista
import trimesh

from flexroad.tasks.products import ply
from flexroad.tasks.types import Mesh
from tests.crossing import Crossing


def roof(crs: str = "EPSG:25832") -> Mesh:
    vertices = np.array([[0.1, 0.2, 0.3], [10, 0, 1], [10, 10, 2.001], [0, 10, 3.7], [5, 15, 4]])
    faces = np.array([[0, 1, 2], [0, 2, 3], [3, 2, 4]], np.int32)
    return Mesh(crs, (295500.0, 5629250.0, 150.0), vertices, faces, np.array([False, True, False]))


HEIGHT_SOURCE = np.array([1, 2, 3], np.uint8)


def parse(data: bytes) -> tuple[list[str], np.ndarray, np.ndarray]:
    """Return header lines, vertices and faces, parsed by the PLY specification."""
    head, body = data.split(b"end_header\n", 1)
    lines = head.decode("ascii").splitlines()
    kinds = {"double": "<f8", "float": "<f4", "uchar": "u1", "int": "<i4", "char": "i1"}
    counts, fields, element = {}, {}, ""
    for words in (line.split() for line in lines):
        if words[0] == "element":
            element, counts[words[1]], fields[words[1]] = words[1], int(words[2]), []
        elif words[:2] == ["property", "list"]:
            fields[element] += [("count", kinds[words[2]]), (words[4], kinds[words[3]], 3)]
        elif words[0] == "property":
            fields[element].append((words[2], kinds[words[1]]))
    vertices = np.frombuffer(body, np.dtype(fields["vertex"]), counts["vertex"])
    faces = np.frombuffer(body, np.dtype(fields["face"]), counts["face"], vertices.nbytes)
    assert len(body) == vertices.nbytes + faces.nbytes
    return lines, vertices, faces


def test_encode_coordinates_are_absolute_and_exact():
    mesh = roof()
    _, vertices, faces = parse(ply.encode(mesh, HEIGHT_SOURCE))
    truth = mesh.vertices + np.array(mesh.origin)
    for axis, name in enumerate("xyz"):
        np.testing.assert_array_equal(vertices[name], truth[:, axis])
    assert (faces["count"] == 3).all()
    np.testing.assert_array_equal(faces["vertex_indices"], mesh.faces)
    np.testing.assert_array_equal(faces["class"], [2, 11, 2])
    np.testing.assert_array_equal(faces["height_source"], HEIGHT_SOURCE)


def test_encode_vertices_have_normals_class_and_height_source():
    _, vertices, _ = parse(ply.encode(roof(), HEIGHT_SOURCE))
    # The faces are (0, 1, 2), (0, 2, 3), which is road, and (3, 2, 4), with height source 1, 2 and 3.
    np.testing.assert_array_equal(vertices["class"], [11, 2, 11, 11, 2])
    np.testing.assert_array_equal(vertices["height_source"], [2, 1, 3, 3, 3])
    normals = np.stack([vertices[name] for name in ("nx", "ny", "nz")], axis=1)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-6)
    up = np.tile([0.0, 0.0, 1.0], (5, 1))
    given = parse(ply.encode(roof(), HEIGHT_SOURCE, up))[1]
    np.testing.assert_array_equal([given[name] for name in ("nx", "ny", "nz")], up.T)
    # Vertex 1 is a corner of the first face alone.
    a, b, c = roof().vertices[:3]
    face = np.cross(b - a, c - a)
    np.testing.assert_allclose(normals[1], face / np.linalg.norm(face), atol=1e-6)


@pytest.mark.parametrize("crs", ["EPSG:25832", 'PROJCRS["a",\n  BASEGEOGCRS["b"]]', 'PROJCRS["Réunion"]'])
def test_encode_header_has_crs_in_one_ascii_line_and_origin(crs):
    lines, _, _ = parse(ply.encode(roof(crs), HEIGHT_SOURCE))
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    assert lines[2].startswith(f"comment crs {crs[:10]}")
    assert lines[3] == "comment origin 295500 5629250 150"


def test_encode_is_read_by_trimesh_and_vtk(tmp_path):
    mesh, path = roof(), tmp_path / "mesh.ply"
    path.write_bytes(ply.encode(mesh, HEIGHT_SOURCE))
    read = trimesh.load_mesh(path, process=False)
    np.testing.assert_array_equal(read.vertices, mesh.vertices + np.array(mesh.origin))
    np.testing.assert_array_equal(read.faces, mesh.faces)
    read = pyvista.read(path)
    np.testing.assert_array_equal(read.faces.reshape(-1, 4)[:, 1:], mesh.faces)
    np.testing.assert_allclose(read.points, mesh.vertices + np.array(mesh.origin), rtol=1e-7)


def test_encode_faces_and_vertices_have_their_level():
    mesh, _ = Crossing((40.0, 30.0)).mesh()
    data = ply.encode(mesh, np.ones(len(mesh.faces), np.uint8))
    lines, vertices, faces = parse(data)
    assert lines.count("property char level") == 2
    np.testing.assert_array_equal(faces["level"], mesh.level)
    np.testing.assert_array_equal(vertices["level"][faces["vertex_indices"]], np.stack([mesh.level] * 3, 1))
    read = trimesh.load(io.BytesIO(data), file_type="ply", process=False)
    np.testing.assert_array_equal(read.faces, mesh.faces)
    assert "level" not in ply.encode(roof(), HEIGHT_SOURCE).split(b"end_header")[0].decode()
