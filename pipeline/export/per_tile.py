"""What workers make of a tile: files of its own, or its part of the one file of LandXML and CityJSON."""

from __future__ import annotations

from dataclasses import dataclass

from flexroad.catalog.ids import safe_name
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.export.joined import part_name
from flexroad.pipeline.export.pieces import Piece
from flexroad.pipeline.export.source import FinishedTile
from flexroad.tasks.export import cityjson, landxml, obj, rhino, step
from flexroad.tasks.spline.surface import NurbsSurface

MATERIALS = "materials.mtl"
"""Name of the file of materials that all OBJ files share."""


@dataclass(frozen=True)
class CityPlace:
    """What the header of a CityJSON file says, on which the parts of all tiles depend."""

    crs: str
    origin: tuple[float, float, float]
    vertical: str | None


def landxml_part(tile: FinishedTile, project: landxml.Project) -> Piece:
    """Return the part of a LandXML file."""
    return Piece({part_name(tile.id): landxml.part(tile.mesh, project.joined).encode()}, {})


def cityjson_part(tile: FinishedTile, place: CityPlace) -> Piece:
    """Return the lines of a CityJSON file."""
    lines = cityjson.features(tile.id, tile.mesh, place.origin, place.vertical)
    return Piece({part_name(tile.id): lines}, {})


def obj_piece(tile: FinishedTile, vertical: str | None) -> Piece:
    """Return the mesh as OBJ, and its place as JSON and, for GIS programs, as ``.prj``."""
    mesh, name = tile.mesh, safe_name(tile.id)
    place = obj.georeference(mesh, vertical)
    files = {
        f"{name}{obj.NAME}": obj.encode(mesh, MATERIALS, vertical),
        f"{name}.json": place.sidecar(obj.AXES),
        f"{name}.prj": place.prj(),
    }
    return Piece(files, {})


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
