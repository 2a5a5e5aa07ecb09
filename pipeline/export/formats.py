"""The formats of `flexroad export`: how each is written from the finished tiles of a run."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from datetime import UTC
from functools import partial
from pathlib import Path
from typing import Any

from flexroad.catalog.storage.paths import Location, remove, write
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.execute import Executor
from flexroad.pipeline.export import (
    along_roads,
    height_fields,
    mosaic,
    per_tile,
    road_lines,
    terrain_tiles,
    tiles3d,
)
from flexroad.pipeline.export.network import network
from flexroad.pipeline.export.options import Options
from flexroad.pipeline.export.photo import Photographed
from flexroad.pipeline.export.pieces import Encode, figures, write_joined, write_pieces
from flexroad.pipeline.export.source import Source
from flexroad.pipeline.graph.borders import has_borders
from flexroad.pipeline.run.finished import FinishedTile
from flexroad.tasks.errors import TaskError
from flexroad.tasks.export import cityjson, landxml, obj, opencrg, opendrive, rhino, step
from flexroad.tasks.export import road_lines as line_file

Write = Callable[[Source, Iterable[FinishedTile], Location, Options, Executor], dict[str, Any] | None]
"""Writes a format of the tiles into a folder; returns what the manifest says of it besides, if anything."""

Check = Callable[[Source, Options], object]


@dataclass(frozen=True)
class Format:
    """One format of exports."""

    title: str
    write: Write
    version: int
    precision_m: float | None
    """Largest distance of a point from the run's mesh or surface (m); None if its files or figures say it."""
    needs_datum: bool = False
    """Whether heights above the ellipsoid are needed."""
    check: Check | None = None
    """Raises an error, before anything is written, if the format cannot be."""


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
            decoded = (landxml.Part.decode(part) for part in parts)
            landxml.join(file, decoded, project, local.parent, options.compress)

    file = folder / f"{source.run.path.name}{name}"
    return write_joined(source, tiles, file, landxml.VERSION, per_tile.landxml_part, project, executor, join)


def write_cityjson(
    source: Source, tiles: Iterable[FinishedTile], folder: Location, options: Options, executor: Executor
) -> dict[str, Any]:
    """Write all meshes as one CityJSONSeq file."""
    place = per_tile.CityPlace(source.crs, (*source.origin, 0.0), source.vertical)

    def join(local: Path, parts: Iterator[bytes]) -> None:
        with local.open("wb") as file:
            file.write(cityjson.header(source.crs, place.origin, source.vertical))
            file.writelines(parts)

    file = folder / f"{source.run.path.name}{cityjson.NAME}"
    return write_joined(source, tiles, file, cityjson.VERSION, per_tile.cityjson_part, place, executor, join)


def write_obj(
    source: Source, tiles: Iterable[FinishedTile], folder: Location, options: Options, executor: Executor
) -> dict[str, Any]:
    """Write each mesh as OBJ: all with one file of materials, or each with its own and a photo."""
    if not options.drape:
        write(folder / per_tile.MATERIALS, obj.encode_materials())
        return _write_each(obj.VERSION, per_tile.obj_piece, source, tiles, folder, options, executor)
    remove(folder / per_tile.MATERIALS)
    items, encode = map(Photographed, tiles), per_tile.draped_obj_piece
    return figures(write_pieces(items, folder, obj.VERSION, encode, source.vertical, executor))


def _write_each(
    version: int,
    encode: Encode,
    source: Source,
    tiles: Iterable[FinishedTile],
    folder: Location,
    options: Options,
    executor: Executor,
) -> dict[str, Any]:
    """Write a format that has files of its own for each tile."""
    return figures(write_pieces(tiles, folder, version, encode, source.vertical, executor))


def _per_tile(
    title: str, version: int, encode: Encode, precision_m: float | None, check: Check | None = None
) -> Format:
    return Format(title, partial(_write_each, version, encode), version, precision_m, check=check)


def _needs_rhino(source: Source, options: Options) -> None:
    try:
        rhino.load_rhino3dm()
    except TaskError as error:
        raise ConfigError(str(error)) from error


def _needs_pmtiles(source: Source, options: Options) -> None:
    terrain_tiles.load_writer()


def _along_roads(title: str, version: int, write: Write) -> Format:
    return Format(title, write, version, None, check=network)


FORMATS = {
    "3dtiles": Format("3D Tiles 1.1, for globes", tiles3d.write_tilesets, tiles3d.VERSION, 0.002, True),
    "landxml": Format("LandXML 1.2, for civil engineering", write_landxml, landxml.VERSION, 0.0001),
    "cityjson": Format("CityJSONSeq 2.0, for city models", write_cityjson, cityjson.VERSION, 0.001),
    "obj": Format("OBJ, for modelling", write_obj, obj.VERSION, 0.0001),
    "heightfield": Format(
        "16-bit height fields, for game engines", height_fields.write_fields, height_fields.VERSION, None
    ),
    "step": _per_tile("STEP AP214, for CAD", step.VERSION, per_tile.step_piece, 1e-9),
    "mosaic": Format("GeoTIFFs over the run, for GIS", mosaic.write_mosaics, mosaic.VERSION, 0.0005),
    "pmtiles": Format(
        "Map tiles of heights", terrain_tiles.write_tiles, terrain_tiles.VERSION, 0.002, check=_needs_pmtiles
    ),
    "3dm": _per_tile("3DM, for Rhino", rhino.VERSION, per_tile.rhino_piece, 1e-4, _needs_rhino),
    "crg": _along_roads("OpenCRG 1.2, for tyres and vehicles", opencrg.VERSION, along_roads.write_crg),
    "xodr": _along_roads("OpenDRIVE 1.8, for driving simulators", opendrive.VERSION, along_roads.write_xodr),
    "lines": _along_roads("Road lines as GeoPackage, for GIS", line_file.VERSION, road_lines.write_lines),
}
"""By the name on the command line."""
