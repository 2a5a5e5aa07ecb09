"""``flexroad prepare``: rasters of a textured mesh, from points sampled on its surface.

With a road mask, the ground truth of the paper's DSC3D section is made, too. The paper only says that the DTM
is refined "via our ECSRC algorithm" and that "road masks, enhanced through ECSRC", take "ground truth terrain
from DTM and road from DSM". Here

- *refined* means: cells with ground points are clustered like road cells, by their heights. Cells outside
  all clusters of `min_area_m2` differ from the surrounding ground by more than `theta_z_m`. The ground filter
  accepted them wrongly (roofs, hedges, floating fragments). They are interpolated from their surroundings.
  Cells without ground points are not clustered: interpolated slopes would connect a roof to its garden.
- *enhanced* means: the road mask is clustered by the DSM, as in the stage `ecsrc`; cells that are not kept
  (crowns, vehicles, roofs) are terrain.

This reference has passed the same filter as the method to be evaluated, so it cannot show errors of the
filter. Reports of figures against it must say so (`CIRCULAR`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from scipy.ndimage import label

from flexroad.catalog import Grid
from flexroad.catalog.crs import short
from flexroad.catalog.to_metres import MetricTransform
from flexroad.pipeline.config.options import MESH, option
from flexroad.pipeline.execute import Executor
from flexroad.tasks.filter import ecsrc
from flexroad.tasks.types import Bools, Floats, RoadMask, TileData
from flexroad.tools.prepare.blockwise import write_blocks
from flexroad.tools.prepare.mesh.georeference import Offset
from flexroad.tools.prepare.mesh.read import read_mesh
from flexroad.tools.prepare.mesh.sample import TexturedMesh, in_metres, orthophoto, sample
from flexroad.tools.prepare.options import PrepareOptions, check_disk, prepared_grid, written
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
from flexroad.tools.prepare.points import tin, to_rasters
from flexroad.tools.prepare.raster_writer import PreparedDataset, RasterWriter
from flexroad.tools.prepare.roads import add_roads, check_roads

BAND = 1024
"""Rows of the orthophoto drawn at a time, to limit the memory."""
REFINE_BYTES, REFERENCE_BYTES = 300, 50
"""Memory of the refinement and of the reference per cell of the area (bytes); measured."""
POINTS = to_rasters.Options(ground="filter")
"""Default options for points of a mesh: they have no classes, so the ground filter is used."""
CIRCULAR = "reference by ECSRC itself (circular)"
"""Text that is added to the name of data with this reference."""
ECSRC = ecsrc.Options(keep_largest=None)
"""The paper's thresholds; all clusters above the least area are kept, as their number grows with the area."""


@dataclass(frozen=True)
class MeshOptions:
    """Options of meshes only."""

    up: Literal["y", "z"] | None = option(
        None, MESH, "The mesh's upward axis; default: y in glTF, z elsewhere."
    )
    offset: Offset | None = option(
        None, MESH, "Position of the mesh's origin; default: from its sidecar file.", "E N H"
    )
    """Easting, northing and height (m)."""
    density: float = option(25.0, MESH, "Sampled points per m2 of the mesh's surface.", "NUMBER", min=0.1)
    seed: int = 0
    """Random seed of the sampling."""
    dop: bool = option(True, MESH, "Make no orthophoto.")
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
        per_cell=max(
            REFERENCE_BYTES if common.roads is not None else 0, REFINE_BYTES if mesh_options.refine else 0
        ),
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
            writer.tags["REFERENCE"] = f"DSM on the road mask that ECSRC keeps, DTM elsewhere: {CIRCULAR}"
        write_blocks(
            writer, _sample_points(writer, mesh, mesh_options, options, common.step_m), options, held, log
        )
        if mesh_options.refine:
            log("refining the terrain")
            dtm, ground = writer.read("dtm", grid), writer.read(to_rasters.GROUND, grid)
            dtm = refine(dtm, ground, grid, options.void_m)
            writer.write("dtm", grid, dtm)
        if mesh_options.dop:
            log("drawing the orthophoto")
            whole = writer.photo_grid
            assert whole is not None
            for row in range(0, whole.height, BAND):
                rows = slice(row, min(row + BAND, whole.height))
                writer.write_photo(orthophoto(mesh, whole.part(rows, slice(0, whole.width))))
        dataset = common.dataset or name
        if has_mask:
            dsm, dtm, road = (writer.read(layer, grid) for layer in ("dsm", "dtm", "road_mask"))
            heights, kept = reference(dsm, dtm, road, grid)
            writer.write("reference", grid, heights)
            writer.write("reference_road", grid, kept)
            dataset = f"{dataset}; {CIRCULAR}"
        published = writer.publish(
            common.tile_size_m, common.date, dataset, common.min_cover, common.assumed_date, held
        )
    return published.with_notes(*mesh.notes, *frame.notes)


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


def refine(dtm: Floats, ground: Bools, grid: Grid, fill_m: float) -> Floats:
    """Interpolate the ground cells of a DTM that ECSRC does not keep.

    - `dtm` ``(H, W)``: bare ground from a ground filter, m; NaN where unknown.
    - `ground` ``(H, W)``: cells with ground points; the heights of the others are interpolated.
    - `fill_m`: gaps up to this width are interpolated linearly (m), wider gaps become NaN.
    - result ``(H, W)``: m; cells without a height in ``dtm`` have none in the result.
    """
    ground = ground & np.isfinite(dtm)
    kept = _kept(dtm, ground, grid)
    voids, _ = label(~kept, np.ones((3, 3)))
    # Voids without a removed ground cell keep their interpolated heights.
    replaced = np.isin(voids, voids[ground & ~kept]) & ~kept
    interpolated = tin.fill_voids(np.where(kept, dtm, np.nan), grid, fill_m)
    return np.where(replaced & np.isfinite(dtm), interpolated, dtm)


def reference(dsm: Floats, dtm: Floats, road: Bools, grid: Grid) -> tuple[Floats, Bools]:
    """Return the paper's ground truth: heights of road and terrain, and the road mask, ``(H, W)`` each.

    - `dsm`, `dtm` ``(H, W)``: highest surface and refined bare ground, m; NaN where unknown.
    - `road` ``(H, W)``: the raw road mask.
    """
    kept = _kept(dsm, road, grid)
    return np.where(kept, dsm, dtm), kept


def _kept(heights: Floats, cells: Bools, grid: Grid) -> Bools:
    """Return the cells that ECSRC keeps if it clusters them by these heights."""
    data = TileData("", grid, grid, heights, heights)
    return ecsrc.ecsrc(data, RoadMask(grid, grid, cells, np.zeros_like(cells)), ECSRC).mask
