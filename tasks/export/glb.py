"""The paper's final mesh as binary glTF with two nodes, road and terrain.

glTF is Y up and viewers compute in float32. Vertices are therefore relative to the tile's whole-metre origin,
and the parent node moves the tile to its place in the run. Origin and CRS are in the scene's ``extras``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from flexroad.tasks.types import Bools, Floats, Mesh

if TYPE_CHECKING:
    import trimesh

VERSION = 1
NAME = ".glb"
MEDIA_TYPE = "model/gltf-binary"

ROAD_COLOUR = (11, 11, 13, 255)
TERRAIN_COLOUR = (141, 131, 108, 255)
"""Red, green, blue and alpha in linear light, as glTF requires (sRGB #3a3a40 and #c4beae)."""


def encode(mesh: Mesh, run_origin: tuple[float, float, float]) -> bytes:
    """Return a mesh as GLB.

    Parameters
    ----------
    mesh : Mesh
        The mesh of one tile, with at least one face.
    run_origin : tuple of float
        Whole-metre (easting, northing, height) shared by all tiles of a run; the origin of the scene.

    Returns
    -------
    bytes
        Node ``tile``, translated by the tile's origin minus the run's, with child nodes ``road`` and
        ``terrain`` (a class without faces has no node). Axes: x east, y up, z south; metres. Equal inputs
        give equal bytes.
    """
    import trimesh

    whole = trimesh.Trimesh(_y_up(mesh.vertices), mesh.faces, process=False)
    scene = trimesh.Scene(metadata=_georeference(mesh, run_origin))
    shift = _y_up(np.subtract(mesh.origin, run_origin))
    scene.graph.update(frame_to="tile", matrix=trimesh.transformations.translation_matrix(shift))
    for name, faces, colour in (("road", mesh.road, ROAD_COLOUR), ("terrain", ~mesh.road, TERRAIN_COLOUR)):
        if faces.any():
            part = _part(whole, faces, name, colour)
            scene.add_geometry(part, node_name=name, geom_name=name, parent_node_name="tile")
    encoded: bytes = scene.export(file_type="glb", include_normals=True)
    return encoded


def _y_up(points: Floats) -> Floats:
    """Rotate (east, north, up) to glTF's (east, up, -north); the orientation of faces is kept."""
    east, north, up = np.moveaxis(points, -1, 0)
    return np.stack([east, up, -north], axis=-1)


def _georeference(mesh: Mesh, run_origin: tuple[float, float, float]) -> dict[str, object]:
    return {
        "crs": mesh.crs,
        "origin": [float(v) for v in mesh.origin],
        "run_origin": [float(v) for v in run_origin],
        "axes": "x east, y up, z south; origins are easting, northing, height; metres",
    }


def _part(whole: trimesh.Trimesh, faces: Bools, name: str, colour: tuple[int, ...]) -> trimesh.Trimesh:
    """Return the faces of one class with the whole mesh's vertex normals, so that shading shows no seam."""
    import trimesh

    used, corners = np.unique(whole.faces[faces], return_inverse=True)
    material = trimesh.visual.material.PBRMaterial(
        name=name, baseColorFactor=colour, metallicFactor=0.0, roughnessFactor=0.95
    )
    return trimesh.Trimesh(
        whole.vertices[used],
        corners.reshape(-1, 3),
        vertex_normals=whole.vertex_normals[used],
        visual=trimesh.visual.TextureVisuals(material=material),
        process=False,
    )
