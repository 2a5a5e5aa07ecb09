"""Meshes of all sampling methods have no fault, and every kind of fault is found."""

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
import shapely
import trimesh
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from scipy.spatial import Delaunay

from flexroad.tasks.errors import MeshFault, TaskError
from flexroad.tasks.metrics.mesh_check import check, faults
from flexroad.tasks.sample import Options
from flexroad.tasks.types import Mesh
from tests.builders import make_grid
from tests.tasks.test_sample import Hills, sampled
from tests.tasks.test_sample_border import block, meshes

ORIGIN = (295500.0, 5629250.0, 150.0)


def mesh_of(vertices, faces) -> Mesh:
    """Return a mesh of vertices ``(V, 2)`` and faces; the heights are different."""
    vertices, faces = np.asarray(vertices, float), np.asarray(faces, np.int32)
    heights = np.arange(len(vertices)) % 7 / 10
    return Mesh("EPSG:25832", ORIGIN, np.c_[vertices, heights], faces, np.zeros(len(faces), bool))


def square(n=5, west=0.0, south=0.0, side=1.0, first=0):
    """Return vertices and faces of n x n quads, cut from south-west to north-east."""
    x, y = np.meshgrid(west + side * np.arange(n + 1), south + side * np.arange(n + 1))
    i = first + np.arange(x.size).reshape(x.shape)
    a, b, c, d = i[:-1, :-1].ravel(), i[:-1, 1:].ravel(), i[1:, 1:].ravel(), i[1:, :-1].ravel()
    return np.c_[x.ravel(), y.ravel()], np.concatenate([np.c_[a, b, c], np.c_[a, c, d]])


def moved(vertex, place):
    vertices, faces = square()
    vertices[vertex] = place
    return mesh_of(vertices, faces)


def with_number(vertex, axis, value):
    mesh = mesh_of(*square())
    mesh.vertices[vertex, axis] = value
    return mesh


def with_face(face, new):
    mesh = mesh_of(*square())
    mesh.faces[face] = new
    return mesh


def with_split_vertex():
    """A vertex that one of its faces has for itself, higher than for the others."""
    vertices, faces = square()
    faces[0, 0] = len(vertices)
    return mesh_of(np.vstack([vertices, vertices[:1]]), faces)


def with_patch(west, south, side):
    """A second square of 2 x 2 quads at this place."""
    vertices, faces = square()
    patch, others = square(2, west, south, side, first=len(vertices))
    return mesh_of(np.vstack([vertices, patch]), np.vstack([faces, others]))


def turned_twice():
    """Faces around a vertex that turn twice; every edge but the outer ones has two faces."""
    angles = np.arange(10) * 2 * np.pi / 5
    radius = 1 + np.arange(10) / 20
    rim = np.c_[radius * np.cos(angles), radius * np.sin(angles)]
    return mesh_of(np.vstack([rim, [[0, 0]]]), [(10, k, (k + 1) % 10) for k in range(10)])


def with_faces(*new, points=()):
    """Further faces, and further points as corners of faces."""
    vertices, faces = square()
    return mesh_of(np.vstack([vertices, *points]), np.vstack([faces, *new]))


UNDER, TOUCH = "outline edges under or over other faces", "outline edges that cross or touch others"
OVERLAP = "edges with overlapping faces"
FAULTS = {
    "NaN": (with_number(7, 2, np.nan), 1, "vertices that are not finite", "vertex 7"),
    "infinite": (with_number(9, 0, -np.inf), 1, "vertices that are not finite", "vertex 9"),
    "too large index": (with_face(3, (0, 1, 36)), 1, "faces with unknown vertices", "face 3"),
    "negative index": (with_face(4, (-1, 1, 2)), 1, "faces with unknown vertices", "face 4"),
    "repeated index": (with_face(0, (0, 1, 1)), 1, "degenerate faces", (0.667, 0)),
    # Vertex 7 is at (1, 1); the place is the middle of the diagonal of the quad in its north-west.
    "no area": (moved(7, (0.5, 1.5)), 1, "degenerate faces", (0.5, 1.5)),
    "moved across an edge": (moved(7, (0.4, 1.6)), 1, "inverted faces", (0.467, 1.533)),
    "looks down": (with_face(0, (1, 0, 7)), 1, "inverted faces", (0.667, 0.333)),
    "vertex twice": (with_split_vertex(), 1, "duplicate vertices", (0, 0)),
    "vertex unused": (with_faces(points=[(9, 8)]), 1, "unused vertices", (9, 8)),
    "face twice": (with_faces(square()[1][0]), 3, OVERLAP, (0.5, 0.5)),
    # A face on two edges of the outline, folded back over the mesh, shares one of them in the same direction.
    "face over others": (with_faces((0, 1, 14)), 1, OVERLAP, (0.5, 0)),
    "layer": (with_patch(1.2, 1.3, 0.5), 8, UNDER, (1.45, 1.3)),
    "layer below all": (with_patch(-1.5, -1.5, 4.0), 20, UNDER, (0.5, 0)),
    "overhanging layer": (with_patch(4.2, 1.3, 0.7), 4, TOUCH, (5, 1.5)),
    "edge at two edges": (with_patch(5.0, 0.5, 1.0), 7, TOUCH, (5, 0.5)),
    "vertex in edge": (with_faces((36, 37, 38), points=[(5, 0.5), (6, 0), (6, 1)]), 3, TOUCH, (5, 0.5)),
    "two turns": (turned_twice(), 2, TOUCH, ""),
}
"""Mesh, number and kind of its faults, and place of the first (m from the corner)."""


@pytest.mark.parametrize("name", FAULTS)
def test_fault_is_found_with_kind_count_and_place(name):
    mesh, count, kind, place = FAULTS[name]
    if isinstance(place, tuple):
        place = f"{ORIGIN[0] + place[0]:.3f}, {ORIGIN[1] + place[1]:.3f}"
    line = f"{count} {kind} (the first at {place}"
    assert len(faults(mesh)) == 1
    with pytest.raises(MeshFault, match="the mesh has .*; this is an error of FlexRoad, report it") as error:
        check(mesh)
    assert line in str(error.value)
    assert isinstance(error.value, TaskError)


def test_faults_several_kinds_of_one_group_are_all_named():
    mesh = with_face(0, (1, 0, 7))
    mesh.faces[5] = 2, 2, 3
    kinds = [(kind, number) for kind, number, _ in faults(mesh)]
    assert kinds == [("degenerate faces", 1), ("inverted faces", 1)]


def test_faults_of_valid_meshes_are_none():
    ring = square()[1][[k for k in range(50) if k not in (12, 37)]]
    beside = with_patch(5.1, 1.0, 1.0)
    in_hole = mesh_of(
        np.vstack([square()[0], [(2.2, 2.2), (2.8, 2.2), (2.8, 2.8)]]), np.vstack([ring, [(36, 37, 38)]])
    )
    at_vertex = square()[1][[0, 25, 6, 31]]
    used, faces = np.unique(at_vertex, return_inverse=True)
    for mesh in (mesh_of(*square()), beside, in_hole, mesh_of(square()[0][used], faces.reshape(-1, 3))):
        check(mesh)


def test_faults_without_faces_are_unused_vertices():
    empty = np.zeros((0, 3), np.int32)
    assert [kind for kind, _, _ in faults(mesh_of(square()[0], empty))] == ["unused vertices"]
    assert faults(mesh_of(np.zeros((0, 2)), empty)) == ()


def conforming(places, faces) -> bool:
    """Return whether any two triangles share nothing, or a vertex of both, or an edge of both."""
    for a, b in combinations(faces, 2):
        shared = sorted(set(a) & set(b))
        common = shapely.intersection(shapely.Polygon(places[a]), shapely.Polygon(places[b]))
        if len(shared) == 2:
            alike = common.geom_type == "LineString" and common.length == pytest.approx(
                np.linalg.norm(np.subtract(*places[shared]))
            )
        else:
            alike = common.geom_type == "Point" if shared else common.is_empty
        if not alike:
            return False
    return True


@st.composite
def triangles(draw):
    """Places on a small lattice, and triangles between them: part of a triangulation, and some others."""
    lattice = st.tuples(st.integers(0, 4), st.integers(0, 4))
    places = np.array(draw(st.lists(lattice, min_size=4, max_size=9, unique=True)), float)
    assume(np.linalg.matrix_rank(places[1:] - places[0]) == 2)
    whole = Delaunay(places).simplices
    kept = draw(st.lists(st.booleans(), min_size=len(whole), max_size=len(whole)))
    corner = st.integers(0, len(places) - 1)
    others = draw(st.lists(st.tuples(corner, corner, corner), max_size=2))
    faces = np.vstack([whole[kept], np.array(others, int).reshape(-1, 3)])
    a, b, c = (places[faces[:, k]] for k in range(3))
    area = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]
    faces[area < 0] = faces[area < 0][:, ::-1]
    faces = faces[area != 0]
    assume(len(faces))
    used, faces = np.unique(faces, return_inverse=True)
    return places[used], faces.reshape(-1, 3)


@settings(max_examples=300)
@given(triangles())
def test_faults_agree_with_pairwise_intersections(made):
    places, faces = made
    assert (faults(mesh_of(places, faces)) == ()) == conforming(places, faces)


@settings(max_examples=60)
@given(
    cell=st.sampled_from([0.2, 0.5, 1.0]),
    shape=st.tuples(st.integers(6, 24), st.integers(6, 24)),
    road_m=st.sampled_from([0.7, 1.0, 2.5]),
    ratio=st.sampled_from([1, 3.3, 10]),
    method=st.sampled_from(["dynamic", "uniform", "corners"]),
    halo=st.sampled_from([0, 2]),
    hole=st.none() | st.tuples(st.floats(0, 12), st.floats(0, 12), st.floats(0.5, 4)),
    data=st.data(),
)
def test_sampled_mesh_of_any_mask_and_survey_has_no_fault(
    cell, shape, road_m, ratio, method, halo, hole, data
):
    """Also where the survey ends at single cells, so that parts of the mesh meet at a vertex only."""
    core = make_grid(shape[1], shape[0], cell)
    mask, outside = (data.draw(arrays.arrays(bool, core.buffered(halo).shape)) for _ in range(2))
    options = Options(method=method, road_m=road_m * cell, terrain_m=ratio * road_m * cell)
    surface = Hills(hole and (core.west + hole[0], core.south + hole[1], hole[2]))
    try:
        mesh = sampled(core, mask, options, surface, halo, outside)
    except TaskError:
        assume(False)
    check(mesh)
    # Vertices of GLB files have 32 bits.
    check(replace(mesh, vertices=mesh.vertices.astype(np.float32).astype(float)))
    assert shapely.coverage_is_valid(shapely.polygons(mesh.vertices[mesh.faces][..., :2]))
    assert trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).is_winding_consistent


@settings(max_examples=20)
@given(
    seed=st.integers(0, 2**31),
    share=st.floats(0, 1),
    method=st.sampled_from(["dynamic", "uniform"]),
    outside=st.booleans(),
)
def test_sampled_meshes_of_tiles_with_shared_border_have_no_fault(seed, share, method, outside):
    rng = np.random.default_rng(seed)
    tiles = block(rng, 1.0, (30, 24), share, inside=rng.random() < 0.5)
    options = Options(method=method, road_m=rng.choice([0.7, 1.0, 2.5]), terrain_m=7.0)

    def beyond(east, north):
        return outside & (rng.random(np.shape(east)) < 0.5)

    for mesh in meshes(tiles, rng, options, beyond):
        check(mesh)
