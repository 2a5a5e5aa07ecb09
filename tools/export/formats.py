"""The formats of `flexroad export`: how each is written from the finished tiles of a run."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from datetime import UTC
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from flexroad.catalog.grid import Bounds
from flexroad.catalog.ids import safe_name
from flexroad.catalog.storage.paths import Location, remove, write
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.execute import Executor
from flexroad.pipeline.graph.borders import has_borders
from flexroad.pipeline.run.finished import FinishedTile
from flexroad.tasks.spline.stepped import SteppedSurface, without_steps
from flexroad.tasks.spline.surface import NurbsSurface
from flexroad.tools.export import (
    along_roads,
    cityjson,
    landxml,
    mosaic,
    obj,
    opencrg,
    opendrive,
    road_lines,
    step,
    tileset,
)
from flexroad.tools.export.georeference import Georeference
from flexroad.tools.export.network import network
from flexroad.tools.export.source import Options, Source, layer_state, texture_of
from flexroad.tools.export.tile_outputs import (
    Encode,
    TileOutput,
    figures,
    part_name,
    write_joined,
    write_outputs,
)

MATERIALS = "materials.mtl"
"""Name of the file of materials that all OBJ files share."""
BEYOND = "a part of the surface is beyond the survey (beyond_survey_m2)"
OF_LEVEL_0 = "the surface is the ground (level 0), which within 20 m of abutments is not the road's"
CUT = "surface cut to the rectangle that the survey covers"
NO_PHOTO = "no orthophoto, in plain colours"


def landxml_part(tile: FinishedTile, project: landxml.Project) -> TileOutput:
    """Return the part of a LandXML file."""
    part = landxml.part(tile.mesh, project.joined)
    return TileOutput({part_name(tile.id): part}, {"height_error_m": _error_m(tile, 10**-landxml.DECIMALS)})


def cityjson_part(tile: FinishedTile, place: Georeference) -> TileOutput:
    """Return the lines of a CityJSON file."""
    lines = cityjson.features(tile.id, tile.mesh, place.origin, place.vertical)
    return TileOutput({part_name(tile.id): lines}, {"height_error_m": _error_m(tile, cityjson.SCALE_M)})


def obj_output(
    tile: FinishedTile, place: Georeference, materials: str = MATERIALS, photo: Bounds | None = None
) -> TileOutput:
    """Return the mesh as OBJ, and its place as JSON and as ``.prj`` for GIS programs."""
    mesh, name = tile.mesh, safe_name(tile.id)
    files = {
        f"{name}{obj.NAME}": obj.encode(mesh, materials, place, photo),
        f"{name}.json": place.sidecar(obj.AXES),
        f"{name}.prj": place.prj(),
    }
    return TileOutput(files, {"height_error_m": _error_m(tile, 10**-obj.DECIMALS)})


def draped_obj_output(tile: FinishedTile, place: Georeference) -> TileOutput:
    """Return the mesh as OBJ with its own materials, its place, and its photo if it has one."""
    image, name = texture_of(tile), safe_name(tile.id)
    materials, photo = f"{name}{obj.NAME_MATERIALS}", f"{name}{obj.NAME_TEXTURE}"
    output = obj_output(tile, place, materials, image.bounds if image else None)
    if image is None:
        return TileOutput(
            {**output.files, materials: obj.encode_materials()}, output.row | {"note": NO_PHOTO}
        )
    return TileOutput({**output.files, materials: obj.encode_materials(photo), photo: image.jpeg}, output.row)


def _error_m(tile: FinishedTile, unit_m: float) -> float:
    """Return the largest vertical distance of a file's vertices from the surface through the mesh's (m).

    Rounding in plan may move a vertex to another cell with another step. So the heights at the exact and the
    rounded place are compared without steps.

    - `unit_m`: the coordinates of a file are multiples of this unit (m).
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


def step_output(tile: FinishedTile, place: Georeference) -> TileOutput:
    """Return the surface as STEP, cut to the part that the survey covers, and its place as JSON."""
    surface, source, name = tile.surface, tile.tile, safe_name(tile.id)
    if not isinstance(surface, NurbsSurface):
        raise ConfigError("its surface is not a NURBS surface, as STEP needs; leave out step")
    bounds, beyond_m2 = step.covered(tile.road)
    steps_m = 0.0
    if isinstance(surface, SteppedSurface):
        inside = ~tile.road.outside[tile.road.grid.window(tile.road.core)]
        steps_m = round(float(np.abs(surface.steps[inside]).max(initial=0.0)), 6)
    about = {"bounds": list(bounds), "beyond_survey_m2": beyond_m2, "steps_max_m": steps_m}
    files = {
        f"{name}{step.NAME}": step.encode(surface, bounds, tile.id, source.datetime, place),
        f"{name}{step.NAME_SIDECAR}": place.sidecar(step.AXES, **about),
    }
    notes = [CUT] if bounds != source.grid.bounds else []
    notes += [BEYOND] if beyond_m2 else []
    notes += [OF_LEVEL_0] if surface.levels else []
    return TileOutput(files, {"steps_max_m": steps_m} | ({"note": "; ".join(notes)} if notes else {}))


Write = Callable[[Source, Iterable[FinishedTile], Location, Options, Executor], dict[str, Any] | None]
"""Writes a format of the tiles into a folder; returns more entries for the manifest, if any."""

Check = Callable[[Source, Options], object]


@dataclass(frozen=True)
class Format:
    """One format of exports."""

    title: str
    write: Write
    version: int
    precision_m: float | None
    """Largest distance of a point from the run's mesh or surface (m); None if its files give it."""
    needs_datum: bool = False
    """Whether heights above the ellipsoid are needed."""
    check: Check | None = None
    """Raises an error, before anything is written, if the format cannot be written."""
    of_meshes: bool = False
    """Whether it has the run's meshes; then the manifest has their distances from the surfaces."""
    of_roads: bool = False
    """Whether its files are roads; then roads on tiles that do not meet are named."""


def write_landxml(
    source: Source, tiles: Iterable[FinishedTile], folder: Location, options: Options, executor: Executor
) -> dict[str, Any]:
    """Write all meshes as one LandXML file."""
    name = landxml.NAME_COMPRESSED if options.compress else landxml.NAME
    latest = max(tile.datetime for tile in source.tiles)
    joined = has_borders(source.run.config.chains[source.variant]["fit"])
    project = landxml.Project(source.run.path.name, latest.astimezone(UTC), source.vertical, joined)

    def join(local: Path, parts: Iterator[bytes]) -> None:
        with local.open("wb") as file:
            landxml.join(file, parts, project, local.parent, options.compress)

    file = folder / f"{source.run.path.name}{name}"
    return write_joined(source, tiles, file, landxml.VERSION, landxml_part, project, executor, join)


def write_cityjson(
    source: Source, tiles: Iterable[FinishedTile], folder: Location, options: Options, executor: Executor
) -> dict[str, Any]:
    """Write all meshes as one CityJSONSeq file."""
    place = source.place

    def join(local: Path, parts: Iterator[bytes]) -> None:
        with local.open("wb") as file:
            file.write(cityjson.header(source.crs, place.origin, source.vertical))
            file.writelines(parts)

    file = folder / f"{source.run.path.name}{cityjson.NAME}"
    return write_joined(source, tiles, file, cityjson.VERSION, cityjson_part, place, executor, join)


def write_obj(
    source: Source, tiles: Iterable[FinishedTile], folder: Location, options: Options, executor: Executor
) -> dict[str, Any]:
    """Write each mesh as OBJ: with one file of materials for all, or each with its own file and a photo."""
    if not options.drape:
        write(folder / MATERIALS, obj.encode_materials())
        return _write_each(obj.VERSION, obj_output, source, tiles, folder, options, executor)
    remove(folder / MATERIALS)
    rows = write_outputs(
        tiles,
        folder,
        obj.VERSION,
        draped_obj_output,
        source.place,
        executor,
        made_of=lambda tile: f"{tile.fingerprint} {layer_state(tile.tile, 'dop')}",
    )
    return figures(rows)


def _write_each(
    version: int,
    encode: Encode,
    source: Source,
    tiles: Iterable[FinishedTile],
    folder: Location,
    options: Options,
    executor: Executor,
) -> dict[str, Any]:
    """Write a format with separate files for each tile."""
    return figures(write_outputs(tiles, folder, version, encode, source.place, executor))


_along_roads = partial(Format, precision_m=None, check=network, of_roads=True)

FORMATS = {
    "3dtiles": Format(
        "3D Tiles 1.1, for globes", tileset.write_tilesets, tileset.VERSION, 0.002, True, of_meshes=True
    ),
    "landxml": Format(
        "LandXML 1.2, for civil engineering", write_landxml, landxml.VERSION, 0.0001, of_meshes=True
    ),
    "cityjson": Format(
        "CityJSONSeq 2.0, for city models", write_cityjson, cityjson.VERSION, 0.001, of_meshes=True
    ),
    "obj": Format("OBJ, for modelling", write_obj, obj.VERSION, 0.0001, of_meshes=True),
    "step": Format(
        "STEP AP214, for CAD", partial(_write_each, step.VERSION, step_output), step.VERSION, 1e-9
    ),
    "mosaic": Format("GeoTIFFs over the run, for GIS", mosaic.write_mosaics, mosaic.VERSION, 0.0005),
    "crg": _along_roads("OpenCRG 1.2, for tyres and vehicles", along_roads.write_crg, opencrg.VERSION),
    "xodr": _along_roads("OpenDRIVE 1.8, for driving simulators", along_roads.write_xodr, opendrive.VERSION),
    "lines": _along_roads("Road lines as GeoPackage, for GIS", road_lines.write_lines, road_lines.VERSION),
}
"""By the name on the command line."""
