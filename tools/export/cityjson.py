"""The meshes of a run as CityJSON text sequence (CityJSONSeq 2.0): a header line, then two lines per tile.

A line is a feature with one city object. ``Road`` is a MultiSurface of triangles that are all traffic areas.
``TINRelief`` is a CompositeSurface. Vertices are whole millimetres from the origin in the header.
"""

from __future__ import annotations

import json
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flexroad.catalog import crs
from flexroad.tasks.errors import TaskError
from flexroad.tasks.types import Mesh

VERSION = 1
NAME = ".city.jsonl"

SCALE_M = 0.001
"""Unit of the vertices (m): a coordinate is exact to half of it."""
LOD = "2"
"""Level of detail: geometry without street furniture and lanes."""
AUTHORITY = "https://www.opengis.net/def/crs/EPSG/0/"

Whole = NDArray[np.int64]


def header(system: str, origin: tuple[float, float, float], vertical: str | None = None) -> bytes:
    """Return the first line: version, transform and CRS.

    The CRS is the compound CRS if the EPSG register has it, else the horizontal CRS: CityJSON allows only one
    code. The vertical CRS is then an attribute of the city objects.
    """
    plan = crs.code(system)
    if plan is None:
        raise TaskError(
            f"CityJSON names a CRS by its EPSG code, and {crs.name(system)!r} has none; choose another format"
        )
    code = crs.code(crs.compound(system, vertical)) if vertical else None
    return _line(
        {
            "type": "CityJSON",
            "version": "2.0",
            "transform": {"scale": [SCALE_M] * 3, "translate": [float(v) for v in origin]},
            "metadata": {"referenceSystem": f"{AUTHORITY}{code or plan}"},
            "CityObjects": {},
            "vertices": [],
        }
    )


def features(
    tile_id: str, mesh: Mesh, origin: tuple[float, float, float], vertical: str | None = None
) -> bytes:
    """Return the lines of one tile: its road and its terrain; a class without faces has no line.

    Decks are bridges; they and tunnels have the number of their level as attribute. Vertices that round to
    the same millimetres are one vertex. Faces that lose their area by that are left out.

    - `tile_id`: id of the tile, from which the ids of the city objects are made.
    """
    # The origins are whole metres and are subtracted first: large coordinates would lose digits.
    points = mesh.vertices + np.subtract(mesh.origin, origin)
    whole = np.rint(points / SCALE_M).astype(np.int64)
    attributes = {"tile": tile_id} | ({"verticalCRS": vertical} if vertical else {})
    lines = []
    ground = np.ones(len(mesh.faces), np.bool_) if mesh.level is None else mesh.level == 0
    objects = [("Road", 0, ground & mesh.road), ("TINRelief", 0, ground & ~mesh.road)]
    for number in mesh.numbers[1:]:
        objects.append(("Bridge" if number > 0 else "Tunnel", number, mesh.level == number))
    for kind, number, faces in objects:
        vertices, corners = _parts(whole, mesh.faces[faces])
        if len(corners):
            name = f"{tile_id}-{kind.lower()}" + (f"{abs(number)}" if number else "")
            own = attributes | ({"level": number} if number else {})
            item = {"type": kind, "attributes": own, "geometry": [_geometry(kind, corners)]}
            lines.append(
                _line(
                    {
                        "type": "CityJSONFeature",
                        "id": name,
                        "CityObjects": {name: item},
                        "vertices": vertices.tolist(),
                    }
                )
            )
    return b"".join(lines)


def _parts(whole: Whole, faces: NDArray[np.int32]) -> tuple[Whole, Whole]:
    """Return the different vertices of faces with an area, and these faces as indices of the vertices."""
    _, number = np.unique(whole, axis=0, return_inverse=True)
    a, b, c = number.reshape(-1)[faces].T
    kept = faces[(a != b) & (b != c) & (c != a)]
    vertices, corners = np.unique(whole[kept.ravel()], axis=0, return_inverse=True)
    return vertices, corners.reshape(-1, 3)


def _geometry(kind: str, corners: Whole) -> dict[str, Any]:
    # A surface is a list of rings; a triangle has one.
    surfaces = corners[:, None, :].tolist()
    if kind == "TINRelief":
        return {"type": "CompositeSurface", "lod": LOD, "boundaries": surfaces}
    meaning = "TrafficArea" if kind == "Road" else "OuterFloorSurface"
    semantics = {"surfaces": [{"type": meaning}], "values": [0] * len(corners)}
    return {"type": "MultiSurface", "lod": LOD, "boundaries": surfaces, "semantics": semantics}


def _line(content: dict[str, Any]) -> bytes:
    return json.dumps(content, separators=(",", ":"), allow_nan=False).encode() + b"\n"
