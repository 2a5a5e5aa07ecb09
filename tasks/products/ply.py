"""The paper's final mesh as binary PLY, with class and height source per face.

Coordinates are absolute and float64. trimesh and VTK write float32 vertices, whose resolution is 0.5 m at a
northing of 5.6 million; therefore this module writes the file itself. VTK also reads them as float32.
Vertices have normals, class and height source, too, because CloudCompare reads only scalars of vertices.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from flexroad.tasks.meshing.normals import mesh_normals
from flexroad.tasks.quality.height_source import HeightSource
from flexroad.tasks.types import Floats, Mesh

VERSION = 3
NAME = ".ply"
MEDIA_TYPE = "application/octet-stream"

ROAD, GROUND = 11, 2
"""Classes of faces: the ASPRS codes of LAS files for road surface and ground."""

VERTEX = np.dtype([("place", "<f8", (3,)), ("normal", "<f4", (3,)), ("class", "u1"), ("height_source", "u1")])
FACE = np.dtype([("corners", "u1"), ("vertices", "<i4", (3,)), ("class", "u1"), ("height_source", "u1")])

HEADER = """\
ply
format binary_little_endian 1.0
comment crs {crs}
comment origin {origin}
comment class {ground} ground, {road} road surface (ASPRS)
comment height_source {height_source}
element vertex {vertices}
property double x
property double y
property double z
property float nx
property float ny
property float nz
property uchar class
property uchar height_source
{level}element face {faces}
property list uchar int vertex_indices
property uchar class
property uchar height_source
{level}end_header
"""
LEVEL = "property char level\n"


def encode(mesh: Mesh, height_source: NDArray[np.uint8], normals: Floats | None = None) -> bytes:
    """Return a mesh as PLY with the `HeightSource` of each face, ``(F,)``.

    Vertices are (easting, northing, height) in metres. A vertex is road if one of its faces is road. It has
    the highest code of height source of its faces: the least certain source. A mesh with levels has the
    property ``level`` of vertices and faces. Header comments have the CRS and, as ``origin``, the tile's
    whole-metre origin, which programs that compute in float32 can subtract.

    Parameters
    ----------
    normals : ndarray, (V, 3), optional
        Unit normals of the vertices (`mesh_normals`); by default normals from the faces alone.
    """
    header = HEADER.format(
        crs=" ".join(mesh.crs.split()),  # WKT may have line breaks, which would end the comment
        origin=" ".join(f"{v:.15g}" for v in mesh.origin),
        ground=GROUND,
        road=ROAD,
        height_source=", ".join(f"{kind} {kind.name.lower()}" for kind in HeightSource),
        vertices=len(mesh.vertices),
        faces=len(mesh.faces),
        level="" if mesh.level is None else LEVEL,
    )
    levelled = [] if mesh.level is None else [("level", "i1")]
    faces = np.empty(len(mesh.faces), [*FACE.descr, *levelled])
    faces["corners"] = 3
    faces["vertices"] = mesh.faces
    faces["class"] = np.where(mesh.road, ROAD, GROUND)
    faces["height_source"] = height_source
    vertices = np.zeros(len(mesh.vertices), [*VERTEX.descr, *levelled])
    vertices["place"] = mesh.vertices + np.asarray(mesh.origin, np.float64)
    vertices["normal"] = mesh_normals(mesh) if normals is None else normals
    vertices["class"] = GROUND
    vertices["class"][mesh.faces[mesh.road]] = ROAD
    for kind in sorted(HeightSource):
        vertices["height_source"][mesh.faces[height_source == kind]] = kind
    if mesh.level is not None:
        faces["level"] = mesh.level
        vertices["level"][mesh.faces] = mesh.level[:, None]
    # PLY headers are ASCII, but names in WKT may have other characters.
    return header.encode("ascii", "backslashreplace") + vertices.tobytes() + faces.tobytes()
