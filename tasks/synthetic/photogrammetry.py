"""A scene as delivered by photogrammetry: a textured mesh with faults, and the true ground and roads."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flexroad.catalog.grid import Grid
from flexroad.tasks.acquire.mesh.sample import TexturedMesh
from flexroad.tasks.synthetic.dsc3d import Place
from flexroad.tasks.synthetic.noise import generator
from flexroad.tasks.synthetic.orthophoto import orthophoto
from flexroad.tasks.synthetic.reconstruction import Reconstruction, reconstruct
from flexroad.tasks.synthetic.scene import Scene, make_scene
from flexroad.tasks.synthetic.triangles import Faces, fragments, lattice, simplified
from flexroad.tasks.types import Floats

NODE_M = 0.5
"""Node spacing of the lattice before simplification (m): 300 x 300 quads, 180,000 triangles."""
GSD_M = 0.25
"""Pixel size of the texture (m)."""
FLOATING_M = (2.0, 9.0)
"""Range of the height of floating fragments over the surface (m)."""


@dataclass(frozen=True, eq=False)
class PhotogrammetryScene:
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


def photogrammetry(place: Place, seed: int) -> PhotogrammetryScene:
    """Make one scene of the stand-in for DSC3D.

    Parameters
    ----------
    place : Place
        A place from `tasks.synthetic.dsc3d.survey`.
    seed : int
        Seed of the survey.

    Returns
    -------
    PhotogrammetryScene
        Equal input gives equal scenes. The mesh fills the square of the place, except for open holes.
    """
    site, grid = place.site, place.grid
    truth = make_scene(grid, seed, site.stratum, place.options)
    surface = make_scene(_nodes(grid), seed, site.stratum, place.options)
    reconstruction = reconstruct(surface, seed, site.faults)
    origin = np.array([grid.west, grid.south, math.floor(reconstruction.height.min())])
    rng = generator(seed, "fragments", *map(int, grid.origin))
    centres = _fragment_centres(reconstruction, site.faults.fragments, origin, grid, rng)
    floating, pieces = fragments(centres, rng)
    vertices, faces = _mesh(reconstruction, site.triangles - len(pieces), origin)
    faces = np.concatenate([faces, pieces + np.int32(len(vertices))])
    vertices = _clip(np.concatenate([vertices, floating]), grid)
    texture = orthophoto(grid, seed, site.stratum, place.options, GSD_M).transpose(1, 2, 0)
    return PhotogrammetryScene(
        site.name, _textured(vertices, faces, texture, origin, grid), truth, surface, reconstruction
    )


def _nodes(grid: Grid) -> Grid:
    """Return the lattice whose outermost cell centres lie on the edges of a grid."""
    cells = Grid.covering(grid.crs, grid.bounds, NODE_M)
    west, north = grid.west - NODE_M / 2, grid.north + NODE_M / 2
    return Grid(grid.crs, west, north, NODE_M, cells.width + 1, cells.height + 1)


def _mesh(reconstruction: Reconstruction, triangles: int, origin: Floats) -> tuple[Floats, Faces]:
    east, north = reconstruction.grid.eastings - origin[0], reconstruction.grid.northings - origin[1]
    return simplified(
        *lattice(east, north, reconstruction.height - origin[2], reconstruction.open), triangles
    )


def _fragment_centres(
    reconstruction: Reconstruction, count: int, origin: Floats, grid: Grid, rng: np.random.Generator
) -> Floats:
    """Return random points above the surface, relative to the origin, ``(count, 3)``."""
    x, y = rng.uniform(0, grid.width * grid.cell, (2, count))
    height = reconstruction.height[reconstruction.grid.cells(x + origin[0], y + origin[1])]
    return np.column_stack([x, y, height - origin[2] + rng.uniform(*FLOATING_M, count)])


def _clip(vertices: Floats, grid: Grid) -> Floats:
    """Return the vertices, clipped to the square in x and y."""
    side = np.array([grid.width, grid.height]) * grid.cell
    return np.column_stack([np.clip(vertices[:, :2], 0, side), vertices[:, 2]])


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
