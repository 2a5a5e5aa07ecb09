"""``flexroad prepare mesh``: rasters of a textured mesh, from points sampled on its surface."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from flexroad.catalog import Grid
from flexroad.catalog.crs import short
from flexroad.catalog.to_metres import MetricTransform
from flexroad.pipeline.config.options import INPUTS, RASTERS, option
from flexroad.pipeline.execute import Executor
from flexroad.tools.prepare.blockwise import write_blocks
from flexroad.tools.prepare.limits import check_disk, prepared_grid
from flexroad.tools.prepare.mesh import reference
from flexroad.tools.prepare.mesh.georeference import Offset
from flexroad.tools.prepare.mesh.read import read_mesh
from flexroad.tools.prepare.mesh.sample import TexturedMesh, in_metres, orthophoto, sample
from flexroad.tools.prepare.options import PrepareOptions, written
from flexroad.tools.prepare.output import disk_errors
from flexroad.tools.prepare.point_buckets import (
    PER_METRE,
    RECORD,
    BlockPart,
    PointBuckets,
    append,
    block_edge,
)
from flexroad.tools.prepare.point_reading import BucketedPoints
from flexroad.tools.prepare.points import to_rasters
from flexroad.tools.prepare.raster_writer import GROUND, PreparedDataset, RasterWriter
from flexroad.tools.prepare.roads import add_roads, check_roads

BAND = 1024
"""Rows of the orthophoto drawn at a time, so that memory does not grow with the area."""
REFINE_BYTES, REFERENCE_BYTES = 300, 50
"""Memory of the refinement and of the reference per cell of the area (bytes); measured."""
POINTS = to_rasters.Options(ground="filter")
"""Default options for points of a mesh: they have no classes, so the ground filter is used."""


@dataclass(frozen=True)
class MeshOptions:
    """The options that only ``prepare mesh`` has."""

    up: Literal["y", "z"] | None = option(
        None, INPUTS, "The mesh's upward axis; default: y in glTF, z elsewhere."
    )
    offset: Offset | None = option(
        None, INPUTS, "Position of the mesh's origin; default: from its sidecar file.", "E N H"
    )
    """Easting, northing and height (m)."""
    density: float = option(25.0, RASTERS, "Sampled points per m2 of the mesh's surface.", "NUMBER", min=0.1)
    seed: int = 0
    """Random seed of the sampling."""
    dop: bool = option(True, RASTERS, "Make no orthophoto.")
    refine: bool = True
    """Whether the DTM is refined by ECSRC, as in the paper."""


def prepare_mesh(
    path: Path,
    out: Path,
    common: PrepareOptions,
    mesh_options: MeshOptions,
    options: to_rasters.Options,
    executor: Executor,
    log: Callable[[str], None],
) -> PreparedDataset:
    """Make the rasters and the catalog of an area from a mesh file.

    - `path`: OBJ, PLY or glTF; see `tools.prepare.mesh.read.read_mesh` for colours and georeference.
    - `out`: output folder.
    - `common`: options shared by all commands.
    - `mesh_options`: options of meshes.
    - `options`: how points become rasters.
    - `executor`: runs the blocks.
    - `log`: called with lines of progress.
    """
    check_roads(common)
    log(f"reading {path}")
    mesh = read_mesh(path, mesh_options.up, common.crs, mesh_options.offset, colours=mesh_options.dop)
    common = replace(common, assumed_date=written([path]))
    return publish_mesh(mesh, path.name, out, common, mesh_options, options, executor, log)


def publish_mesh(
    mesh: TexturedMesh,
    name: str,
    out: Path,
    common: PrepareOptions,
    mesh_options: MeshOptions,
    options: to_rasters.Options,
    executor: Executor,
    log: Callable[[str], None],
) -> PreparedDataset:
    """Make the rasters and the catalog of a mesh in memory; ``name`` is its source. See `prepare_mesh`."""
    frame = MetricTransform.of(mesh.crs, mesh.bounds[:2], common.to_crs, common.height_unit)
    mesh = in_metres(mesh, frame)
    grid = prepared_grid(
        mesh.bounds,
        frame.target,
        common,
        name,
        out,
        photo=mesh_options.dop,
        per_cell=_whole(mesh_options, common),
    )
    points = mesh_options.density * mesh.area
    remedy = "use a lower --density, or a part of the mesh"
    check_disk(out, RECORD.itemsize * points, f"the {points:,.0f} points sampled on {name}", remedy)
    dop_cell = common.dop_cell_m if mesh_options.dop else None
    log(f"{len(mesh.faces):,} faces over {grid.width} x {grid.height} cells in {short(grid.crs)}")
    with (
        RasterWriter(out, grid, dop_cell, _tags(name, mesh_options, options), frame.vertical) as writer,
        executor.held() as held,
    ):
        has_mask = add_roads(writer, common)
        if has_mask:
            writer.tags["REFERENCE"] = (
                f"DSM on the road mask that ECSRC keeps, DTM elsewhere: {reference.CIRCULAR}"
            )
        write_blocks(
            writer, _sample_points(writer, mesh, mesh_options, options, common.step_m), options, held, log
        )
        if mesh_options.refine:
            log("refining the terrain")
            dtm, ground = writer.read("dtm", grid), writer.read(GROUND, grid)
            dtm = reference.refine(dtm, ground, grid, options.void_m)
            writer.write("dtm", grid, dtm)
        if mesh_options.dop:
            log("drawing the orthophoto")
            _draw_photo(writer, mesh)
        dataset = common.dataset or name
        if has_mask:
            _write_reference(writer)
            dataset = f"{dataset}; {reference.CIRCULAR}"
        published = writer.publish(
            common.tile_size_m, common.date, dataset, common.min_cover, common.assumed_date, held
        )
    return published.with_notes(*mesh.notes, *frame.notes)


def _whole(mesh_options: MeshOptions, common: PrepareOptions) -> int:
    """Return the memory of the steps that hold the complete area (bytes per cell)."""
    needed = REFERENCE_BYTES if common.roads is not None else 0
    return max(needed, REFINE_BYTES) if mesh_options.refine else needed


def _tags(name: str, mesh_options: MeshOptions, options: to_rasters.Options) -> dict[str, str]:
    by_layer = to_rasters.tags(options)
    tags = {
        "SOURCE": f"{name}; {mesh_options.density:g} points per m2 of surface, seed {mesh_options.seed}",
        "DSM": by_layer["DSM"],
        "ROAD_HEIGHT": by_layer["ROAD_HEIGHT"],
        "DTM": by_layer["DTM"] + ("; refined by ECSRC" if mesh_options.refine else ""),
    }
    if mesh_options.dop:
        tags["DOP"] = "texture of the highest surface, from straight above"
    return tags


def _sample_points(
    writer: RasterWriter,
    mesh: TexturedMesh,
    mesh_options: MeshOptions,
    options: to_rasters.Options,
    step: float,
) -> BucketedPoints:
    """Sample points on the mesh and sort them into buckets on disk."""
    area = writer.grid.width * writer.grid.height * writer.grid.cell**2
    reach = to_rasters.points_reach_m(options, writer.grid.cell)
    edge = block_edge(mesh_options.density * mesh.area, area, reach, step)
    block_parts = list[BlockPart]()
    with disk_errors(writer.out):
        for part in sample(mesh, mesh_options.density, mesh_options.seed):
            easting, northing, height = (
                np.rint(axis * PER_METRE).astype(np.int64)
                for axis in (part.easting, part.northing, part.height)
            )
            records = np.zeros(len(part), RECORD)
            records["height"] = height
            block_parts += append(writer.scratch / "points", edge, easting, northing, records)
    return BucketedPoints(PointBuckets.of(edge, block_parts), mesh.bounds, (), (), 0)


def _draw_photo(writer: RasterWriter, mesh: TexturedMesh) -> None:
    whole = writer.photo_grid
    assert whole is not None
    for row in range(0, whole.height, BAND):
        rows = min(BAND, whole.height - row)
        north = whole.north - row * whole.cell
        writer.write_photo(
            orthophoto(mesh, Grid(whole.crs, whole.west, north, whole.cell, whole.width, rows))
        )


def _write_reference(writer: RasterWriter) -> None:
    dsm, dtm, road = (writer.read(layer, writer.grid) for layer in ("dsm", "dtm", "road_mask"))
    heights, kept = reference.reference(dsm, dtm, road, writer.grid)
    writer.write("reference", writer.grid, heights)
    writer.write("reference_road", writer.grid, kept)
