"""A scene as photogrammetry delivers it: a textured mesh with faults, and the truth behind it."""

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
"""Spacing of the lattice that is simplified: 300 x 300 quads, 180,000 triangles."""
GSD_M = 0.25
"""Pixel of the texture."""
FLOATING_M = (2.0, 9.0)
"""Of fragments, over the surface."""


@dataclass(frozen=True, eq=False)
class PhotogrammetryScene:
    """One made scene, as it is and as photographs show it."""

    name: str
    mesh: TexturedMesh
    """One texture, seen from straight above; walls are smeared with it."""
    truth: Scene
    """The scene in cells of a metre, without noise: ``reference`` is the true ground incl. decks,
    ``reference_road`` the true roads, ``road_mask`` roads as a segmentation would find them."""
    surface: Scene
    """The same at the mesh's nodes: what was photographed."""
    reconstruction: Reconstruction
    """The surface that the mesh was simplified from."""


def photogrammetry(place: Place, seed: int) -> PhotogrammetryScene:
    """Make one of the stand-in's scenes.

    Parameters
    ----------
    place : Place
        One of `tasks.synthetic.dsc3d.survey`.
    seed : int
        The same as the survey's.

    Returns
    -------
    PhotogrammetryScene
        Equal input gives equal scenes. The mesh fills the place's square, but for open holes.
    """
    site, grid = place.site, place.grid
    truth = make_scene(grid, seed, site.stratum, place.options)
    surface = make_scene(_nodes(grid), seed, site.stratum, place.options)
    made = reconstruct(surface, seed, site.faults)
    origin = np.array([grid.west, grid.south, math.floor(made.height.min())])
    rng = generator(seed, "fragments", *map(int, grid.origin))
    floating, pieces = fragments(_above(made, site.faults.fragments, origin, grid, rng), rng)
    vertices, faces = _mesh(made, site.triangles - len(pieces), origin)
    faces = np.concatenate([faces, pieces + np.int32(len(vertices))])
    vertices = _inside(np.concatenate([vertices, floating]), grid)
    texture = orthophoto(grid, seed, site.stratum, place.options, GSD_M).transpose(1, 2, 0)
    return PhotogrammetryScene(
        site.name, _textured(vertices, faces, texture, origin, grid), truth, surface, made
    )


def _nodes(grid: Grid) -> Grid:
    """Return the lattice whose cell centres span a grid from edge to edge."""
    wide = Grid.covering(grid.crs, grid.bounds, NODE_M)
    west, north = grid.west - NODE_M / 2, grid.north + NODE_M / 2
    return Grid(grid.crs, west, north, NODE_M, wide.width + 1, wide.height + 1)


def _mesh(made: Reconstruction, triangles: int, origin: Floats) -> tuple[Floats, Faces]:
    east, north = made.grid.eastings - origin[0], made.grid.northings - origin[1]
    return simplified(*lattice(east, north, made.height - origin[2], made.open), triangles)


def _above(made: Reconstruction, count: int, origin: Floats, grid: Grid, rng: np.random.Generator) -> Floats:
    """Return points ``(count, 3)`` over the surface, from the origin."""
    x, y = rng.uniform(0, grid.width * grid.cell, (2, count))
    height = made.height[made.grid.cells(x + origin[0], y + origin[1])]
    return np.column_stack([x, y, height - origin[2] + rng.uniform(*FLOATING_M, count)])


def _inside(vertices: Floats, grid: Grid) -> Floats:
    """Return vertices with those a little outside the square pulled onto its edge."""
    side = np.array([grid.width, grid.height]) * grid.cell
    return np.column_stack([np.clip(vertices[:, :2], 0, side), vertices[:, 2]])


def _textured(
    vertices: Floats, faces: Faces, texture: NDArray[np.uint8], origin: Floats, grid: Grid
) -> TexturedMesh:
    # v counts from below, as northings do.
    uv = vertices[:, :2] / (np.array([grid.width, grid.height]) * grid.cell)
    return TexturedMesh(
        crs=grid.crs,
        vertices=vertices + origin,
        faces=faces,
        texture=np.zeros(len(faces), np.int32),
        textures=(np.ascontiguousarray(texture),),
        uv=uv[faces].astype(np.float32),
    )
