"""The mesh of a tile as Wavefront OBJ and MTL, with the orthophoto as texture if the tile has one.

Z is the height. Plan coordinates are relative to a whole-metre origin that all tiles of a run share, since
most readers compute in float32. The format has no CRS: origin and CRS are comments in the file, and entries
of a JSON file next to it.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flexroad.catalog.grid import Bounds
from flexroad.tasks.types import Mesh
from flexroad.tools.export.georeference import Georeference

VERSION = 2
NAME = ".obj"
NAME_MATERIALS = ".mtl"
NAME_TEXTURE = ".jpg"

AXES = "x east, y north, relative to origin; z height; metres"
DECIMALS = 4
"""Decimals of coordinates (m): the rounding error is at most 0.05 mm."""
COLOURS = {"road": (0.23, 0.23, 0.25), "terrain": (0.77, 0.745, 0.68)}
"""Red, green and blue of the classes without a texture, 0 to 1, sRGB."""


def encode(mesh: Mesh, materials: str, place: Georeference, photo: Bounds | None = None) -> bytes:
    """Return a mesh as OBJ with a group and a material for road and for terrain.

    Decks and tunnels are groups ``level_1``, by the number of their level, with the material of roads.

    Rounding errors are at most 0.05 mm, of texture coordinates 5e-8 of the image. Faces are counter-clockwise
    from above. A class without faces has no group.

    - `materials`: name of the file of `encode_materials`, without a folder.
    - `photo`: west, south, east and north of the outer edges of the materials' image (m); None without an
      image.
    """
    head = [f"# {line}" for line in place.lines()]
    blocks = ["\n".join([*head, f"# axes {AXES}", f"mtllib {materials}", ""])]
    shift = np.subtract(mesh.origin, place.origin)
    blocks.append(_rows("v %.4f %.4f %.4f\n", (mesh.vertices + shift).T))
    if photo:
        blocks.append(_rows("vt %.7f %.7f\n", mesh.texture_coordinates(photo).T))
    row = "f %d/%d %d/%d %d/%d\n" if photo else "f %d %d %d\n"
    ground = np.ones(len(mesh.faces), np.bool_) if mesh.level is None else mesh.level == 0
    groups = [("road", "road", ground & mesh.road), ("terrain", "terrain", ground & ~mesh.road)]
    groups += [(f"level_{number}", "road", mesh.level == number) for number in mesh.numbers[1:]]
    for name, material, faces in groups:
        if faces.any():
            corners = mesh.faces[faces].T + 1
            blocks.append(f"g {name}\nusemtl {material}\n")
            blocks.append(_rows(row, np.repeat(corners, 2, axis=0) if photo else corners))
    return "".join(blocks).encode()


def encode_materials(texture: str | None = None) -> bytes:
    """Return the materials ``road`` and ``terrain`` as MTL.

    - `texture`: name of the image of both materials, without a folder; by default each has one colour.
    """
    lines = []
    for name, colour in COLOURS.items():
        shade = (1.0, 1.0, 1.0) if texture else colour
        lines += [f"newmtl {name}", f"Kd {shade[0]:g} {shade[1]:g} {shade[2]:g}", "Ks 0 0 0", "illum 1"]
        # No options such as -clamp: many readers take them for a part of the name.
        lines += [f"map_Kd {texture}"] if texture else []
    return "\n".join([*lines, ""]).encode()


def _rows(row: str, columns: Iterable[NDArray[Any]]) -> str:
    """Return columns of numbers as text, all rows in the same format."""
    return "".join(map(row.__mod__, zip(*(column.tolist() for column in columns), strict=True)))
