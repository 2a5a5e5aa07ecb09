"""The paper's final mesh as binary glTF with two nodes, road and terrain, and a node for each other level.

glTF is Y up and viewers compute in float32. Vertices are therefore relative to the tile's whole-metre origin,
and the parent node moves the tile to its place in the run. Origin and CRS are in the scene's ``extras``.
An orthophoto is embedded as one JPEG image that both nodes share. It is shown without a light
(``KHR_materials_unlit``): it already has the sun of the flight, and a viewer's light would darken it again.

This module writes the file itself: trimesh takes four times as long for the same arrays, mostly for comparing
them with each other. Its import takes as long as a complete tile.
"""

from __future__ import annotations

import io
import json
import struct
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flexroad.catalog.grid import Bounds
from flexroad.catalog.lazy import lazy
from flexroad.tasks.meshing.normals import mesh_normals
from flexroad.tasks.types import Floats, Mesh, Orthophoto

Image = lazy("PIL.Image")

VERSION = 4
NAME = ".glb"
MEDIA_TYPE = "model/gltf-binary"

ROAD_COLOUR = (11, 11, 13, 255)
TERRAIN_COLOUR = (141, 131, 108, 255)
"""Red, green, blue and alpha in linear light, as glTF requires."""
ROAD_SRGB, TERRAIN_SRGB = (58, 58, 64), (196, 190, 174)
"""The same colours as in images: #3a3a40 and #c4beae."""

SAMPLER = {"magFilter": 9729, "minFilter": 9987, "wrapS": 33071, "wrapT": 33071}
"""Linear filters and CLAMP_TO_EDGE, in glTF's codes: a border does not mix with the opposite border."""
UNSIGNED_SHORT, UNSIGNED_INT, FLOAT = 5123, 5125, 5126
ARRAY_BUFFER, ELEMENT_ARRAY_BUFFER = 34962, 34963
UNLIT = "KHR_materials_unlit"
IDENTITY = (1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0)
"""The first twelve of the sixteen numbers of a matrix, by columns; the translation follows."""


@dataclass(frozen=True, eq=False)
class Texture:
    """An orthophoto as the image of a mesh."""

    jpeg: bytes
    bounds: Bounds
    """West, south, east and north of the image's outer edges (m, in the mesh's CRS)."""


def texture(photo: Orthophoto, quality: int) -> Texture:
    """Return an orthophoto as a JPEG image; pixels without a colour have the mean colour.

    Parameters
    ----------
    photo : Orthophoto
        It has at least one known pixel.
    quality : int
        Quality of the JPEG encoder, 1 to 95.
    """
    mean = photo.colour[:, photo.known].mean(axis=1).round().astype(np.uint8)
    colour = np.where(photo.known, photo.colour, mean[:, None, None])
    return Texture(jpeg(np.moveaxis(colour, 0, -1), quality), photo.grid.bounds)


def jpeg(colour: NDArray[np.uint8], quality: int) -> bytes:
    """Return an image, ``(h, w, 3)``, as JPEG."""
    encoded = io.BytesIO()
    Image.fromarray(colour).save(encoded, "JPEG", quality=quality)
    return encoded.getvalue()


def encode(
    mesh: Mesh,
    run_origin: tuple[float, float, float],
    texture: Texture | None = None,
    normals: Floats | None = None,
    name: str = "tile",
) -> bytes:
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
    normals : ndarray, (V, 3), optional
        Unit normals of the vertices (`mesh_normals`); by default normals from the faces alone.
    name : str
        Name of the tile's node, such as its id.

    Returns
    -------
    bytes
        A node translated by the tile's origin minus the run's, with child nodes ``road`` and ``terrain`` (a
        class without faces has no node). A deck or tunnel is the child ``road`` of a node named after its
        level, such as ``level 1``. Axes: x east, y up, z south; metres. Equal inputs give equal bytes.
    """
    normals = mesh_normals(mesh) if normals is None else normals
    uv = mesh.texture_coordinates(texture.bounds) if texture else None
    file = _File()
    shift = _y_up(np.subtract(mesh.origin, run_origin)).tolist()
    tile = file.add("nodes", {"name": name, "children": [], "matrix": [*IDENTITY, *shift, 1.0]})
    image = file.add_image(texture.jpeg) if texture else None
    for number in mesh.numbers:
        parent = tile
        if number:
            parent = file.add("nodes", {"name": f"level {number}", "children": []})
            file.tree["nodes"][tile]["children"].append(parent)
        of_level = mesh.level == number if mesh.level is not None else np.ones(len(mesh.faces), np.bool_)
        for kind, is_kind, colour in (
            ("road", mesh.road, ROAD_COLOUR),
            ("terrain", ~mesh.road, TERRAIN_COLOUR),
        ):
            faces = is_kind & of_level
            if faces.any():
                used, corners = mesh.part(faces)
                node = file.add_mesh(
                    mesh.vertices[used],
                    normals[used],
                    None if uv is None else uv[used],
                    corners,
                    _material(kind, colour, image, image is not None),
                )
                file.tree["nodes"][parent]["children"].append(node)
    return file.encoded(tile, _georeference(mesh, run_origin))


def encode_ground(
    places: Floats, normals: Floats, uv: Floats, faces: NDArray[np.int32], image: bytes, photo: bool
) -> bytes:
    """Return a mesh with an image as GLB with one node, ``ground``.

    Parameters
    ----------
    places, normals : ndarray, (V, 3)
        The vertices in a local frame: east, north and up (m), and their unit normals.
    uv : ndarray, (V, 2)
        Their places in the image, from west to east and from south to north.
    faces : ndarray, (F, 3)
        Counter-clockwise from above.
    image : bytes
        The image seen from above, JPEG.
    photo : bool
        Whether the image is made from photos, which are shown without a light.
    """
    file = _File()
    material = _material("ground", (), file.add_image(image), photo)
    return file.encoded(file.add_mesh(places, normals, uv, faces, material))


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


def _material(name: str, colour: tuple[int, ...], texture: int | None, unlit: bool) -> dict[str, Any]:
    """Return the material of a part: an image, or a colour in linear light, 0 to 255."""
    look: dict[str, Any] = {"metallicFactor": 0.0, "roughnessFactor": 0.95}
    if texture is None:
        look["baseColorFactor"] = [value / 255 for value in colour]
    else:
        look |= {"roughnessFactor": 1.0, "baseColorTexture": {"index": texture}}
    return {"name": name, "pbrMetallicRoughness": look} | ({"extensions": {UNLIT: {}}} if unlit else {})


class _File:
    """A binary glTF file in the making: the tree of its JSON, and the pieces of its buffer."""

    def __init__(self) -> None:
        self.tree: dict[str, list[dict[str, Any]]] = {}
        self.pieces: list[bytes] = []
        self.size = 0
        """Bytes of the buffer."""

    def add(self, kind: str, entry: dict[str, Any]) -> int:
        """Add an entry to one of the tree's lists; return its index."""
        entries = self.tree.setdefault(kind, [])
        entries.append(entry)
        return len(entries) - 1

    def add_image(self, jpeg: bytes) -> int:
        """Add an image; return the index of its texture."""
        view = self._add_view(jpeg)
        image = self.add("images", {"name": "orthophoto", "bufferView": view, "mimeType": "image/jpeg"})
        return self.add("textures", {"source": image, "sampler": self.add("samplers", SAMPLER)})

    def add_mesh(
        self,
        places: Floats,
        normals: Floats,
        uv: Floats | None,
        faces: NDArray[np.int32],
        material: dict[str, Any],
    ) -> int:
        """Add a mesh, named like its material; return the index of its node.

        - `places`, `normals` ``(V, 3)``: places and normals of its vertices, in east, north and up.
        - `uv` ``(V, 2)``: places in the image, from west to east and from south to north.
        """
        attributes = {
            "POSITION": self._add_array(_y_up(places), "VEC3"),
            "NORMAL": self._add_array(_y_up(normals), "VEC3"),
        }
        if uv is not None:
            # glTF counts from the top of the image.
            from_top = np.column_stack([uv[:, 0], 1.0 - uv[:, 1]])
            attributes["TEXCOORD_0"] = self._add_array(from_top, "VEC2")
        primitive = {
            "attributes": attributes,
            "indices": self._add_indices(faces, len(places)),
            "material": self.add("materials", material),
        }
        name = material["name"]
        return self.add(
            "nodes", {"name": name, "mesh": self.add("meshes", {"name": name, "primitives": [primitive]})}
        )

    def encoded(self, root: int, extras: dict[str, object] | None = None) -> bytes:
        """Return the file whose scene has one root node; ``extras`` are further data of the scene."""
        scene = {"nodes": [root]} | ({"extras": extras} if extras else {})
        head = {"asset": {"version": "2.0", "generator": "FlexRoad"}, "scene": 0, "scenes": [scene]}
        tree = head | self.tree | {"buffers": [{"byteLength": self.size}]}
        if any("extensions" in material for material in self.tree["materials"]):
            tree["extensionsUsed"] = [UNLIT]
        text = json.dumps(tree, separators=(",", ":"), allow_nan=False).encode()
        text += b" " * (-len(text) % 4)
        chunks = [struct.pack("<I4s", len(text), b"JSON"), text, struct.pack("<I4s", self.size, b"BIN\0")]
        length = 12 + sum(map(len, chunks)) + self.size
        return b"".join([struct.pack("<4sII", b"glTF", 2, length), *chunks, *self.pieces])

    def _add_array(self, values: Floats, kind: str) -> int:
        """Add one value per vertex as float32; return the index of the accessor."""
        array = values.astype("<f4")
        accessor = {
            "bufferView": self._add_view(array.tobytes(), ARRAY_BUFFER),
            "componentType": FLOAT, "count": len(array), "type": kind,
            "min": [float(axis.min()) for axis in array.T], "max": [float(axis.max()) for axis in array.T],
        }  # fmt: skip
        return self.add("accessors", accessor)

    def _add_indices(self, faces: NDArray[np.int32], count: int) -> int:
        """Add the corners of faces, indices into ``count`` vertices; return the index of the accessor."""
        # The largest number of a type has a special meaning in graphics.
        short = count < 2**16
        view = self._add_view(faces.astype("<u2" if short else "<u4").tobytes(), ELEMENT_ARRAY_BUFFER)
        kind = UNSIGNED_SHORT if short else UNSIGNED_INT
        accessor = {"bufferView": view, "componentType": kind, "count": faces.size, "type": "SCALAR"}
        return self.add("accessors", accessor)

    def _add_view(self, data: bytes, target: int | None = None) -> int:
        """Add bytes to the buffer at a multiple of 4; return the index of the view."""
        view = {"buffer": 0, "byteOffset": self.size, "byteLength": len(data)}
        padding = bytes(-len(data) % 4)
        self.pieces += [data, padding]
        self.size += len(data) + len(padding)
        return self.add("bufferViews", view | ({"target": target} if target else {}))
