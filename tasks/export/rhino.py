"""The surface of a tile and its mesh as 3DM file, for Rhino and Grasshopper; needs the library rhino3dm.

The file has three layers: ``surface``, the NURBS surface cut to the tile's core (`tasks.spline.cut`),
``road`` and ``terrain``, the faces of the mesh. Coordinates are float64, in metres, relative to a whole-metre
origin in plan that all tiles of a run share; z is the height. The document's user texts have origin and CRS.
"""

from __future__ import annotations

import base64
from collections.abc import Mapping
from importlib import import_module
from typing import Any

import numpy as np

from flexroad.catalog.grid import Bounds
from flexroad.tasks.errors import TaskError
from flexroad.tasks.georeference import Georeference
from flexroad.tasks.meshing.parts import part
from flexroad.tasks.spline.cut import patch
from flexroad.tasks.spline.surface import NurbsSurface
from flexroad.tasks.types import Bools, Mesh

VERSION = 3
NAME = ".3dm"
MEDIA_TYPE = "model/vnd.3dm"

AXES = "x east, y north, relative to origin; z height; metres"
INSTALL = "pip install 'flexroad[export]'"
COLOURS = {"surface": (90, 130, 180), "road": (58, 58, 64), "terrain": (196, 190, 174)}
"""Red, green and blue of the layers, 0 to 255."""
TOLERANCE_M = 1e-4
"""Distance below which Rhino takes points for equal (m)."""


def encode(
    mesh: Mesh,
    surface: NurbsSurface | None,
    bounds: Bounds,
    place: Georeference,
    more: Mapping[str, str] | None = None,
) -> bytes:
    """Return a surface and a mesh as 3DM.

    Two files of equal inputs differ in their identifiers and times, which the library chooses.

    Parameters
    ----------
    mesh : Mesh
        The mesh of the tile. A class without faces has a layer without an object. A deck or tube has the
        layer ``level 1``, by the number of its level.
    surface : NurbsSurface or None
        The surface of the tile; None if it is no NURBS. Its layer is then empty.
    bounds : tuple of float
        West, south, east and north of the part of the surface, as the tile's core (m).
    place : Georeference
        What coordinates are relative to; its height is 0.
    more : mapping, optional
        Other user texts by name.

    Raises
    ------
    TaskError
        If rhino3dm is missing, or if the bounds and the surface's domain do not overlap.
    """
    rhino = load_rhino3dm()
    model = rhino.File3dm()
    model.Settings.ModelUnitSystem = rhino.UnitSystem.Meters
    model.Settings.ModelAbsoluteTolerance = TOLERANCE_M
    for key, value in (_texts(place) | dict(more or {})).items():
        model.Strings[key] = value
    layers = {name: _layer(rhino, model, name, colour) for name, colour in COLOURS.items()}
    if surface is not None:
        model.Objects.AddSurface(_surface(rhino, surface, bounds, place), layers["surface"])
    ground = np.ones(len(mesh.faces), np.bool_) if mesh.level is None else mesh.level == 0
    for name, faces in (("road", ground & mesh.road), ("terrain", ground & ~mesh.road)):
        if faces.any():
            model.Objects.AddMesh(_mesh(rhino, mesh, faces, place), layers[name])
    for number in mesh.numbers[1:]:
        layer = _layer(rhino, model, f"level {number}", COLOURS["road"])
        model.Objects.AddMesh(_mesh(rhino, mesh, np.asarray(mesh.level == number), place), layer)
    return base64.b64decode(model.Encode())


def load_rhino3dm() -> Any:
    """Return the library rhino3dm.

    Raises
    ------
    TaskError
        If it is not installed.
    """
    try:
        return import_module("rhino3dm")
    except ImportError as error:
        raise TaskError(f"3DM files need rhino3dm: {INSTALL}") from error


def _texts(place: Georeference) -> dict[str, str]:
    return {
        "crs": place.crs,
        "vertical_crs": place.vertical or "unknown",
        "origin": " ".join(f"{v:.15g}" for v in place.origin),
        "axes": AXES,
    }


def _layer(rhino: Any, model: Any, name: str, colour: tuple[int, int, int]) -> Any:
    """Add a layer; return the attributes of an object on it."""
    layer = rhino.Layer()
    layer.Name = name
    layer.Color = (*colour, 255)
    attributes = rhino.ObjectAttributes()
    attributes.LayerIndex = model.Layers.Add(layer)
    attributes.Name = name
    return attributes


def _surface(rhino: Any, surface: NurbsSurface, bounds: Bounds, place: Georeference) -> Any:
    """Return the part of a surface as rhino3dm's surface."""
    nurbs, rational = patch(surface, bounds, place.origin[:2])
    rows, cols, _ = nurbs.points.shape
    p, q = nurbs.degree
    made = rhino.NurbsSurface.Create(3, rational, p + 1, q + 1, cols, rows)
    # OpenNURBS leaves out the first and the last knot, on which no point of the surface depends.
    for into, knots in ((made.KnotsU, nurbs.knots_u), (made.KnotsV, nurbs.knots_v)):
        for k, knot in enumerate(knots[1:-1].tolist()):
            into[k] = knot
    points = nurbs.points.copy()
    points[..., :3] *= points[..., 3:]
    for row in range(rows):
        for col in range(cols):
            made.Points[col, row] = rhino.Point4d(*points[row, col].tolist())
    return made


def _mesh(rhino: Any, mesh: Mesh, faces: Bools, place: Georeference) -> Any:
    """Return some faces as rhino3dm's mesh."""
    used, corners = part(mesh, faces)
    points = mesh.vertices[used] + np.subtract(mesh.origin, place.origin)
    made = rhino.Mesh()
    made.Vertices.UseDoublePrecisionVertices = True
    for point in points.tolist():
        made.Vertices.AddPoint3d(*point)
    for corner in corners.tolist():
        made.Faces.AddFace(*corner)
    made.Normals.ComputeNormals()
    return made
