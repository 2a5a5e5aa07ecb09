"""A textured mesh as binary glTF, for viewers and for ``flexroad prepare mesh``."""

from __future__ import annotations

import numpy as np

from flexroad.catalog.lazy import lazy
from flexroad.tasks.acquire.mesh.sample import TexturedMesh

PIL = lazy("PIL")
trimesh = lazy("trimesh")


def encode(mesh: TexturedMesh) -> bytes:
    """Return a mesh with one texture as GLB.

    Vertices are relative to the whole-metre corner of the mesh, in glTF's axes (x east, y up, z south). CRS
    and corner are in the scene's ``extras``, as in FlexRoad's other GLB files. Equal input gives equal bytes.

    Parameters
    ----------
    mesh : TexturedMesh
        Faces that share a vertex must also share its texture coordinates.
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
