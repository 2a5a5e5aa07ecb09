"""The paper's final mesh as binary glTF with two nodes, road and terrain.

glTF is Y up and viewers compute in float32. Vertices are therefore relative to the tile's whole-metre origin,
and the parent node moves the tile to its place in the run. Origin and CRS are in the scene's ``extras``.
An orthophoto is embedded as one JPEG image that both nodes share.
"""

from __future__ import annotations

import io
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from flexroad.catalog.grid import Bounds
from flexroad.tasks.meshing.parts import texture_coordinates
from flexroad.tasks.meshing.relief import Sheet
from flexroad.tasks.types import Bools, Floats, Mesh, Orthophoto

if TYPE_CHECKING:
    import trimesh

VERSION = 1
NAME = ".glb"
MEDIA_TYPE = "model/gltf-binary"

ROAD_COLOUR = (11, 11, 13, 255)
TERRAIN_COLOUR = (141, 131, 108, 255)
"""Red, green, blue and alpha in linear light, as glTF requires."""
ROAD_SRGB, TERRAIN_SRGB = (58, 58, 64), (196, 190, 174)
"""The same colours as in images: #3a3a40 and #c4beae."""

SAMPLER = {"magFilter": 9729, "minFilter": 9987, "wrapS": 33071, "wrapT": 33071}
"""Linear filters and CLAMP_TO_EDGE, in glTF's codes: a border takes no colour of the opposite one."""


@dataclass(frozen=True, eq=False)
class Texture:
    """An orthophoto as the image of a mesh."""

    jpeg: bytes
    bounds: Bounds
    """West, south, east and north of the image's outer edges (m, in the mesh's CRS)."""


def texture(photo: Orthophoto, quality: int) -> Texture:
    """Return an orthophoto as a JPEG image; pixels without a colour have the mean of the others.

    Parameters
    ----------
    photo : Orthophoto
        With one known pixel at least.
    quality : int
        Quality of the JPEG encoder, 1 to 95.
    """
    mean = photo.colour[:, photo.known].mean(axis=1).round().astype(np.uint8)
    colour = np.where(photo.known, photo.colour, mean[:, None, None])
    return Texture(jpeg(np.moveaxis(colour, 0, -1), quality), photo.grid.bounds)


def jpeg(colour: NDArray[np.uint8], quality: int) -> bytes:
    """Return an image, ``(h, w, 3)``, as JPEG."""
    from PIL import Image

    encoded = io.BytesIO()
    Image.fromarray(colour).save(encoded, "JPEG", quality=quality)
    return encoded.getvalue()


def encode(mesh: Mesh, run_origin: tuple[float, float, float], texture: Texture | None = None) -> bytes:
    """Return a mesh as GLB.

    Parameters
    ----------
    mesh : Mesh
        The mesh of one tile, with at least one face.
    run_origin : tuple of float
        Whole-metre (easting, northing, height) shared by all tiles of a run; the origin of the scene.
    texture : Texture, optional
        The image seen from above; by default road and terrain have one colour each. Positions, normals and
        faces do not depend on it.

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
    uv = texture_coordinates(mesh, texture.bounds) if texture else None
    shift = _y_up(np.subtract(mesh.origin, run_origin))
    scene.graph.update(frame_to="tile", matrix=trimesh.transformations.translation_matrix(shift))
    for name, faces, colour in (("road", mesh.road, ROAD_COLOUR), ("terrain", ~mesh.road, TERRAIN_COLOUR)):
        if faces.any():
            part = _part(whole, faces, _material(name, colour, textured=texture is not None), uv)
            scene.add_geometry(part, node_name=name, geom_name=name, parent_node_name="tile")
    embed = _Embedded(texture.jpeg).options if texture else {}
    encoded: bytes = scene.export(file_type="glb", include_normals=True, **embed)
    return encoded


def encode_sheet(sheet: Sheet, local: Floats, bounds: Bounds, image: bytes) -> bytes:
    """Return a coarse copy of meshes with its image as GLB.

    Parameters
    ----------
    sheet : Sheet
        Triangles and skirt.
    local : ndarray, (V, 3)
        Its points in a frame of their own: east, north and up (m).
    bounds : tuple of float
        West, south, east and north of the image's outer edges (m, in the CRS of the sheet).
    image : bytes
        The image seen from above, JPEG.

    Returns
    -------
    bytes
        One node, ``ground``. Axes: x east, y up, z south; metres. The skirt has the colours and normals of
        the edge above it, so that it does not show.
    """
    import trimesh

    top = trimesh.Trimesh(_y_up(local[: sheet.top.max() + 1]), sheet.faces[: sheet.count], process=False)
    west, south, east, north = bounds
    uv = (sheet.points[sheet.top, :2] - (west, south)) / (east - west, north - south)
    ground = trimesh.Trimesh(
        _y_up(local),
        sheet.faces,
        vertex_normals=top.vertex_normals[sheet.top],
        visual=trimesh.visual.TextureVisuals(uv=uv, material=_material("ground", (), textured=True)),
        process=False,
    )
    scene = trimesh.Scene()
    scene.add_geometry(ground, node_name="ground", geom_name="ground")
    encoded: bytes = scene.export(file_type="glb", include_normals=True, **_Embedded(image).options)
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


def _material(name: str, colour: tuple[int, ...], textured: bool) -> trimesh.visual.material.PBRMaterial:
    import trimesh

    look = {"roughnessFactor": 1.0} if textured else {"baseColorFactor": colour, "roughnessFactor": 0.95}
    return trimesh.visual.material.PBRMaterial(name=name, metallicFactor=0.0, **look)


def _part(
    whole: trimesh.Trimesh, faces: Bools, material: trimesh.visual.material.PBRMaterial, uv: Floats | None
) -> trimesh.Trimesh:
    """Return the faces of one class with the whole mesh's vertex normals, so that shading shows no seam."""
    import trimesh

    used, corners = np.unique(whole.faces[faces], return_inverse=True)
    return trimesh.Trimesh(
        whole.vertices[used],
        corners.reshape(-1, 3),
        vertex_normals=whole.vertex_normals[used],
        # trimesh's v is upward and is turned into glTF's, which is downward, when it is written.
        visual=trimesh.visual.TextureVisuals(uv=None if uv is None else uv[used], material=material),
        process=False,
    )


@dataclass(frozen=True)
class _Embedded:
    """The image of all materials, added to trimesh's file: trimesh itself would encode it again."""

    jpeg: bytes

    @property
    def options(self) -> dict[str, Any]:
        """The options of trimesh's exporter that add the image."""
        return {"buffer_postprocessor": self._add_bytes, "tree_postprocessor": self._add_texture}

    def _add_bytes(self, buffers: dict[str, bytes], _: dict[str, Any]) -> None:
        padding = -len(self.jpeg) % 4
        buffers["image"] = self.jpeg + bytes(padding)

    def _add_texture(self, tree: dict[str, Any]) -> None:
        views = tree["bufferViews"]
        views[-1]["byteLength"] = len(self.jpeg)
        tree["images"] = [{"name": "orthophoto", "bufferView": len(views) - 1, "mimeType": "image/jpeg"}]
        tree["samplers"] = [SAMPLER]
        tree["textures"] = [{"source": 0, "sampler": 0}]
        for material in tree["materials"]:
            material["pbrMetallicRoughness"]["baseColorTexture"] = {"index": 0}
