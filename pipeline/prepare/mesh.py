"""``prepare mesh``: the rasters of a textured mesh, by way of points like those of a laser scanner."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from flexroad.catalog import Grid
from flexroad.catalog.crs import short
from flexroad.catalog.to_metres import MetricTransform
from flexroad.pipeline.execute import Executor
from flexroad.pipeline.prepare.asked import Asked
from flexroad.pipeline.prepare.blocks import fill, sheet_grid
from flexroad.pipeline.prepare.roads import add_roads
from flexroad.pipeline.prepare.sheet import GROUND, Published, Sheet
from flexroad.pipeline.prepare.spool import PER_METRE, RECORD, Blocks, Place, Spooled, edge_for, room
from flexroad.tasks.acquire.mesh import reference
from flexroad.tasks.acquire.mesh.georeference import Offset
from flexroad.tasks.acquire.mesh.read import read_mesh
from flexroad.tasks.acquire.mesh.sample import TexturedMesh, in_metres, orthophoto, sample
from flexroad.tasks.acquire.points import to_rasters

BAND = 1024
"""Rows of the orthophoto drawn at a time: memory does not grow with the area."""
POINTS = to_rasters.Options(ground="filter")
"""A mesh has no classes."""


@dataclass(frozen=True)
class MeshAsked:
    """The options of ``prepare mesh`` alone."""

    up: Literal["y", "z"] | None = None
    """The file's upward axis; by default y in glTF and z elsewhere."""
    offset: Offset | None = None
    """Easting, northing and height of the mesh's zero; by default that of the sidecar."""
    density: float = 25.0
    """Points per m2 of surface."""
    seed: int = 0
    """Of the points' places."""
    dop: bool = True
    """Whether an orthophoto is drawn."""
    refine: bool = True
    """Whether the DTM is refined by ECSRC, as in the paper."""


def prepare_mesh(
    path: Path,
    out: Path,
    asked: Asked,
    mesh_asked: MeshAsked,
    options: to_rasters.Options,
    executor: Executor,
    say: Callable[[str], None],
) -> Published:
    """Make rasters and catalog of a mesh file.

    Parameters
    ----------
    path : Path
        OBJ, PLY or glTF; see `tasks.acquire.mesh.read.read_mesh` for colours and place.
    out : Path
        Folder to publish in.
    asked, mesh_asked : Asked, MeshAsked
        What the user wants.
    options : to_rasters.Options
        How points become rasters.
    executor : Executor
        Where blocks are worked on.
    say : callable
        Told what is going on.

    Raises
    ------
    TaskError, CatalogError, ConfigError
        If the mesh or the roads cannot be used, or the folder not be written; nothing is left behind.
    """
    say(f"reading {path}")
    mesh = read_mesh(path, mesh_asked.up, asked.crs, mesh_asked.offset, colours=mesh_asked.dop)
    return publish_mesh(mesh, path.name, out, asked, mesh_asked, options, executor, say)


def publish_mesh(
    mesh: TexturedMesh,
    name: str,
    out: Path,
    asked: Asked,
    mesh_asked: MeshAsked,
    options: to_rasters.Options,
    executor: Executor,
    say: Callable[[str], None],
) -> Published:
    """Make rasters and catalog of a mesh in memory, called by its source's name; see `prepare_mesh`."""
    frame = MetricTransform.of(mesh.crs, mesh.bounds[:2], asked.to_crs, asked.height_unit)
    mesh = in_metres(mesh, frame)
    grid = sheet_grid(mesh.bounds, frame.target, asked.cell_m, asked.step_m)
    dop_cell = asked.dop_cell_m if mesh_asked.dop else None
    say(f"{len(mesh.faces):,} faces over {grid.width} x {grid.height} cells in {short(grid.crs)}")
    with Sheet(out, grid, dop_cell, _facts(name, mesh_asked, options)) as sheet:
        masked = add_roads(sheet, asked)
        if masked:
            sheet.facts["REFERENCE"] = (
                f"DSM on the road mask that ECSRC keeps, DTM elsewhere: {reference.CIRCULAR}"
            )
        fill(sheet, _spooled(sheet, mesh, mesh_asked, options, asked.step_m), options, executor, say)
        if mesh_asked.refine:
            say("refining the terrain")
            dtm, ground = sheet.read("dtm", grid), sheet.read(GROUND, grid)
            dtm = reference.refine(dtm, ground, grid, options.void_m)
            sheet.write("dtm", grid, dtm)
        if mesh_asked.dop:
            say("drawing the orthophoto")
            _draw(sheet, mesh)
        dataset = asked.dataset or name
        if masked:
            _refer(sheet)
            dataset = f"{dataset}; {reference.CIRCULAR}"
        published = sheet.publish(asked.tile_size_m, asked.date, dataset)
    return published.noting(*mesh.notes, *frame.notes)


def _facts(name: str, mesh_asked: MeshAsked, options: to_rasters.Options) -> dict[str, str]:
    made = to_rasters.facts(options)
    facts = {
        "SOURCE": f"{name}; {mesh_asked.density:g} points per m2 of surface, seed {mesh_asked.seed}",
        "DSM": made["DSM"],
        "DTM": made["DTM"] + ("; refined by ECSRC" if mesh_asked.refine else ""),
    }
    if mesh_asked.dop:
        facts["DOP"] = "texture of the highest surface, from straight above"
    return facts


def _spooled(
    sheet: Sheet, mesh: TexturedMesh, mesh_asked: MeshAsked, options: to_rasters.Options, step: float
) -> Spooled:
    """Put points of the mesh into blocks on disk."""
    area = sheet.grid.width * sheet.grid.height * sheet.grid.cell**2
    reach = to_rasters.reach_m(options, sheet.grid.cell)
    edge = edge_for(mesh_asked.density * mesh.area, area, reach, step)
    blocks, places = Blocks(sheet.scratch / "points", edge), set[Place]()
    with room(sheet.out):
        blocks.folder.mkdir()
        for part in sample(mesh, mesh_asked.density, mesh_asked.seed):
            easting, northing, height = (
                np.rint(axis * PER_METRE).astype(np.int64)
                for axis in (part.easting, part.northing, part.height)
            )
            records = np.zeros(len(part), RECORD)
            records["height"] = height
            places |= blocks.append(easting, northing, records)
    return Spooled(blocks, frozenset(places), mesh.bounds, (), (), 0)


def _draw(sheet: Sheet, mesh: TexturedMesh) -> None:
    whole = sheet.photo_grid
    assert whole is not None
    for row in range(0, whole.height, BAND):
        rows = min(BAND, whole.height - row)
        north = whole.north - row * whole.cell
        sheet.write_photo(orthophoto(mesh, Grid(whole.crs, whole.west, north, whole.cell, whole.width, rows)))


def _refer(sheet: Sheet) -> None:
    dsm, dtm, road = (sheet.read(layer, sheet.grid) for layer in ("dsm", "dtm", "road_mask"))
    heights, kept = reference.reference(dsm, dtm, road, sheet.grid)
    sheet.write("reference", sheet.grid, heights)
    sheet.write("reference_road", sheet.grid, kept)
