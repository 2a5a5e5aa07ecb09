"""The paper's final mesh as binary glTF: two nodes, road and terrain, in small numbers.

glTF is Y up and viewers compute in float32, so vertices stay relative to the tile's whole-metre origin and
the node above them moves the tile to its place in the run. What that drops, origin and CRS, is in the
scene's ``extras``.
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
"""Asphalt and dry ground; red, green, blue, alpha in linear light as glTF wants (sRGB #3a3a40, #c4beae)."""


def encode(mesh: Mesh, run_origin: tuple[float, float, float]) -> bytes:
    """Return a mesh as GLB.

    Parameters
    ----------
    mesh : Mesh
        The mesh of one tile, with at least one face.
    run_origin : tuple of float
        Whole-metre (easting, northing, height) shared by all tiles of a run; the scene's zero.

    Returns
    -------
    bytes
        Node ``tile``, moved by the tile's origin minus the run's, over nodes ``road`` and ``terrain`` (a
        class without faces has no node). Axes: x east, y up, z south; metres. Equal input, equal bytes.
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
    """Turn (east, north, up) into glTF's (east, up, -north): a rotation, so faces keep their side."""
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
    """Cut one class out, with the normals of the whole: no seam in the shading along the road's edge."""
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
