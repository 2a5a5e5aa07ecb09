"""What workers make of a tile: files of its own, or its part of the one file of LandXML and CityJSON."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flexroad.catalog.grid import Bounds
from flexroad.catalog.ids import safe_name
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.export.photo import Photographed, texture_of
from flexroad.pipeline.export.pieces import Piece, part_name
from flexroad.pipeline.run.finished import FinishedTile
from flexroad.tasks.export import cityjson, landxml, obj, rhino, step
from flexroad.tasks.spline.stepped import without_steps
from flexroad.tasks.spline.surface import NurbsSurface

MATERIALS = "materials.mtl"
"""Name of the file of materials that all OBJ files share."""
NO_PHOTO = "no orthophoto, in plain colours"


@dataclass(frozen=True)
class CityPlace:
    """What the header of a CityJSON file says, on which the parts of all tiles depend."""

    crs: str
    origin: tuple[float, float, float]
    vertical: str | None


def landxml_part(tile: FinishedTile, project: landxml.Project) -> Piece:
    """Return the part of a LandXML file."""
    part = landxml.part(tile.mesh, project.joined).encode()
    return Piece({part_name(tile.id): part}, {"height_error_m": _error_m(tile, 10**-landxml.DECIMALS)})


def cityjson_part(tile: FinishedTile, place: CityPlace) -> Piece:
    """Return the lines of a CityJSON file."""
    lines = cityjson.features(tile.id, tile.mesh, place.origin, place.vertical)
    return Piece({part_name(tile.id): lines}, {"height_error_m": _error_m(tile, cityjson.SCALE_M)})


def obj_piece(tile: FinishedTile, vertical: str | None) -> Piece:
    """Return the mesh as OBJ, and its place as JSON and, for GIS programs, as ``.prj``."""
    return _obj(tile, vertical, MATERIALS, None)


def draped_obj_piece(item: Photographed, vertical: str | None) -> Piece:
    """Return the mesh as OBJ with its own materials, its photo, if it has one, and its place."""
    tile, name = item.tile, safe_name(item.id)
    image = texture_of(tile).image
    materials, photo = f"{name}{obj.NAME_MATERIALS}", f"{name}{obj.NAME_TEXTURE}"
    piece = _obj(tile, vertical, materials, image.bounds if image else None)
    if image is None:
        return Piece({**piece.files, materials: obj.encode_materials()}, piece.row | {"note": NO_PHOTO})
    return Piece({**piece.files, materials: obj.encode_materials(photo), photo: image.jpeg}, piece.row)


def _obj(tile: FinishedTile, vertical: str | None, materials: str, photo: Bounds | None) -> Piece:
    mesh, name = tile.mesh, safe_name(tile.id)
    place = obj.georeference(mesh, vertical)
    files = {
        f"{name}{obj.NAME}": obj.encode(mesh, materials, vertical, photo),
        f"{name}.json": place.sidecar(obj.AXES),
        f"{name}.prj": place.prj(),
    }
    return Piece(files, {"height_error_m": _error_m(tile, 10**-obj.DECIMALS)})


def _error_m(tile: FinishedTile, unit_m: float) -> float:
    """Return the largest vertical distance of a file's vertices from the surface through the mesh's (m).

    A coordinate that is rounded in plan may be in another cell, with another step. Between the two places the
    surface therefore counts without its steps.

    Parameters
    ----------
    unit_m : float
        Of this unit the coordinates of a file are multiples (m).
    """
    points = tile.mesh.vertices + tile.mesh.origin
    written = np.rint(points / unit_m) * unit_m
    west, south, east, north = tile.tile.grid.bounds
    heights = without_steps(tile.surface).height
    here, there = (
        heights(np.clip(x, west, east), np.clip(y, south, north)) for x, y, _ in (points.T, written.T)
    )
    errors = (written[:, 2] - points[:, 2]) - (there - here)
    return float(np.nanmax(np.abs(errors), initial=0.0))


def step_piece(tile: FinishedTile, vertical: str | None) -> Piece:
    """Return the surface as STEP, cut to the tile, and its place as JSON."""
    surface, source, name = tile.surface, tile.tile, safe_name(tile.id)
    if not isinstance(surface, NurbsSurface):
        raise ConfigError("its surface is no NURBS surface, and STEP has no other; leave out step")
    files = {
        f"{name}{step.NAME}": step.encode(surface, source.grid.bounds, tile.id, source.datetime, vertical),
        f"{name}{step.NAME_SIDECAR}": step.georeference(surface, vertical).sidecar(step.AXES),
    }
    return Piece(files, {})


def rhino_piece(tile: FinishedTile, vertical: str | None) -> Piece:
    """Return surface and mesh as 3DM."""
    surface = tile.surface
    nurbs = surface if isinstance(surface, NurbsSurface) else None
    data = rhino.encode(tile.mesh, nurbs, tile.tile.grid.bounds, vertical)
    return Piece({f"{safe_name(tile.id)}{rhino.NAME}": data}, {})
