"""A scene as delivered by photogrammetry: a textured mesh with faults, and the true ground and roads."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flexroad.catalog.grid import Grid
from flexroad.catalog.lazy import lazy
from flexroad.tasks.types import Bools, Floats
from flexroad.tools.prepare.mesh.sample import TexturedMesh
from flexroad.tools.synthetic.dsc3d import Place, Reconstruction, reconstruct
from flexroad.tools.synthetic.orthophoto import orthophoto
from flexroad.tools.synthetic.scene import Scene, make_scene
from flexroad.tools.synthetic.world import generator

PIL = lazy("PIL")
pv = lazy("pyvista")
trimesh = lazy("trimesh")

NODE_M = 0.5
"""Node spacing of the lattice before simplification (m): 300 x 300 quads, 180,000 triangles."""
GSD_M = 0.25
"""Pixel size of the texture (m)."""
FLOATING_M = (2.0, 9.0)
"""Range of the height of floating fragments over the surface (m)."""
Faces = NDArray[np.int32]
FRAGMENT_M = (0.4, 1.5)
"""Least and greatest radius of a floating fragment (m)."""
RIM = 7
"""Number of corners of a floating fragment."""


@dataclass(frozen=True, eq=False)
class _PhotogrammetryScene:
    """One synthetic scene: its true surface and its photogrammetric mesh."""

    name: str
    mesh: TexturedMesh
    """One texture, an orthophoto; it is stretched along walls."""
    truth: Scene
    """The scene with cells of 1 m, without noise: ``reference`` is the true ground with bridges,
    ``reference_road`` the true roads, ``road_mask`` the roads with the errors of a segmentation."""
    surface: Scene
    """The scene at the nodes of the lattice, before reconstruction."""
    reconstruction: Reconstruction
    """The reconstructed surface, before simplification."""


def photogrammetry(place: Place, seed: int) -> _PhotogrammetryScene:
    """Make one scene of the stand-in for DSC3D.

    - result: equal input gives equal scenes. The mesh fills the square of the place, except for open holes.
    """
    site, grid = place.site, place.grid
    truth = make_scene(grid, seed, site.stratum, place.options)
    surface = make_scene(_nodes(grid), seed, site.stratum, place.options)
    reconstruction = reconstruct(surface, seed, site.faults)
    origin = np.array([grid.west, grid.south, math.floor(reconstruction.height.min())])
    rng = generator(seed, "fragments", *map(int, grid.origin))
    # Random points above the surface, relative to the origin.
    number = site.faults.fragments
    x, y = rng.uniform(0, grid.width * grid.cell, (2, number))
    height = reconstruction.height[reconstruction.grid.cells(x + origin[0], y + origin[1])]
    centres = np.column_stack([x, y, height - origin[2] + rng.uniform(*FLOATING_M, number)])
    floating, pieces = fragments(centres, rng)
    east, north = reconstruction.grid.eastings - origin[0], reconstruction.grid.northings - origin[1]
    nodes = lattice(east, north, reconstruction.height - origin[2], reconstruction.open)
    vertices, faces = simplified(*nodes, site.triangles - len(pieces))
    faces = np.concatenate([faces, pieces + np.int32(len(vertices))])
    vertices = np.concatenate([vertices, floating])
    vertices[:, :2] = np.clip(vertices[:, :2], 0, np.array([grid.width, grid.height]) * grid.cell)
    texture = orthophoto(grid, seed, site.stratum, place.options, GSD_M).transpose(1, 2, 0)
    return _PhotogrammetryScene(
        site.name, _textured(vertices, faces, texture, origin, grid), truth, surface, reconstruction
    )


def _nodes(grid: Grid) -> Grid:
    """Return the lattice whose outermost cell centres lie on the edges of a grid."""
    cells = Grid.covering(grid.crs, grid.bounds, NODE_M)
    west, north = grid.west - NODE_M / 2, grid.north + NODE_M / 2
    return Grid(grid.crs, west, north, NODE_M, cells.width + 1, cells.height + 1)


def _textured(
    vertices: Floats, faces: Faces, texture: NDArray[np.uint8], origin: Floats, grid: Grid
) -> TexturedMesh:
    # v increases northwards.
    uv = vertices[:, :2] / (np.array([grid.width, grid.height]) * grid.cell)
    return TexturedMesh(
        crs=grid.crs,
        vertices=vertices + origin,
        faces=faces,
        texture=np.zeros(len(faces), np.int32),
        textures=(np.ascontiguousarray(texture),),
        uv=uv[faces].astype(np.float32),
    )


def encode(mesh: TexturedMesh) -> bytes:
    """Return a mesh with one texture as GLB.

    Vertices are relative to the whole-metre corner of the mesh, in glTF's axes (x east, y up, z south). CRS
    and corner are in the scene's ``extras``, as in FlexRoad's other GLB files. Equal input gives equal bytes.

    - `mesh`: faces that share a vertex must also share its texture coordinates.
    """
    assert mesh.uv is not None
    origin = np.floor(mesh.vertices.min(axis=0))
    east, north, up = (mesh.vertices - origin).T
    uv = np.zeros((len(mesh.vertices), 2), np.float32)
    uv[mesh.faces] = mesh.uv
    material = trimesh.visual.material.PBRMaterial(
        name="orthophoto",
        baseColorTexture=PIL.Image.fromarray(mesh.textures[0]),
        metallicFactor=0.0,
        roughnessFactor=1.0,
    )
    visual = trimesh.visual.TextureVisuals(uv=uv, material=material)
    part = trimesh.Trimesh(np.column_stack([east, up, -north]), mesh.faces, visual=visual, process=False)
    place = {"crs": mesh.crs, "run_origin": [float(value) for value in origin]}
    scene = trimesh.Scene(metadata=place)
    scene.add_geometry(part, node_name="scene", geom_name="scene")
    encoded: bytes = scene.export(file_type="glb")
    return encoded


def lattice(eastings: Floats, northings: Floats, height: Floats, gap: Bools) -> tuple[Floats, Faces]:
    """Return vertices ``(V, 3)`` and faces ``(F, 3)``, two per quad, counter-clockwise from above.

    - `eastings`, `northings`: coordinates of the nodes (m); northings descend.
    - `height`, `gap`: heights of the nodes (m), and nodes in gaps; quads with a node in a gap are left out.
    """
    x, y = np.meshgrid(eastings, northings)
    node = np.arange(height.size, dtype=np.int32).reshape(height.shape)
    nw, sw, se, ne = node[:-1, :-1], node[1:, :-1], node[1:, 1:], node[:-1, 1:]
    quads = np.stack([nw, sw, se, nw, se, ne], axis=-1).reshape(-1, 2, 3)
    complete = ~gap.ravel()[quads].any(axis=(1, 2))
    return np.column_stack([x.ravel(), y.ravel(), height.ravel()]), quads[complete].reshape(-1, 3)


def simplified(vertices: Floats, faces: Faces, triangles: int) -> tuple[Floats, Faces]:
    """Return a mesh with about ``triangles`` triangles, large where the surface is flat.

    Edges are collapsed in the order of their error (quadrics), as in photogrammetry software. Coordinates
    should be small, because they are converted to float32.
    """
    mesh = pv.PolyData.from_regular_faces(vertices, faces).clean()
    if mesh.n_cells > triangles:
        mesh = mesh.decimate(1 - triangles / mesh.n_cells)
    return np.asarray(mesh.points, np.float64), mesh.regular_faces.astype(np.int32)


def fragments(centres: Floats, rng: np.random.Generator) -> tuple[Floats, Faces]:
    """Return small irregular pieces of surface around points ``(n, 3)``, facing up."""
    n = len(centres)
    radius = rng.uniform(*FRAGMENT_M, (n, 1)) * rng.uniform(0.6, 1.4, (n, RIM))
    turn = np.linspace(0, 2 * np.pi, RIM, endpoint=False) + rng.uniform(0, 2 * np.pi, (n, 1))
    tilt = rng.normal(0, 0.3, (n, 1, 2))
    out = np.stack([radius * np.cos(turn), radius * np.sin(turn)], axis=-1)
    rise = (out * tilt).sum(axis=-1) + rng.normal(0, 0.1, (n, RIM))
    rim = centres[:, None] + np.concatenate([out, rise[..., None]], axis=-1)
    vertices = np.concatenate([centres[:, None], rim], axis=1).reshape(-1, 3)
    corner = np.arange(RIM)
    fan = np.column_stack([np.zeros(RIM, np.int64), 1 + corner, 1 + (corner + 1) % RIM])
    faces = fan + (RIM + 1) * np.arange(n)[:, None, None]
    return vertices, faces.reshape(-1, 3).astype(np.int32)
