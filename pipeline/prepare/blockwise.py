"""Rasters from points in buckets on disk, made block by block and in parallel."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track

from flexroad.catalog import Grid
from flexroad.catalog.text import count
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.execute import Executor
from flexroad.pipeline.prepare.output import disk_errors
from flexroad.pipeline.prepare.point_buckets import (
    BlockIndex,
    BucketedPoints,
    PointBuckets,
)
from flexroad.pipeline.prepare.raster_writer import GROUND, RasterWriter
from flexroad.tasks import memory
from flexroad.tasks.acquire.points.to_rasters import Options, rasterise, reach_m
from flexroad.tasks.types import Orthophoto

POINT_BYTES, CELL_BYTES, PIXEL_BYTES = 200, 200, 20
"""Memory that a block takes per point, cell and pixel of the orthophoto (bytes); measured."""


@dataclass(frozen=True)
class _BlockJob:
    """The input of one worker call: a block of ground whose rasters are made."""

    buckets: PointBuckets
    grid: Grid
    """Cells of the block."""
    options: Options
    dop_cell: float | None
    """Pixel of the orthophoto (m); None if there is none."""
    target: Path
    """Output file with the rasters, ``.npz``."""


def write_blocks(
    writer: RasterWriter,
    bucketed: BucketedPoints,
    options: Options,
    executor: Executor,
    log: Callable[[str], None],
) -> None:
    """Make the rasters of all blocks and write them; a progress bar is shown on stderr.

    Parameters
    ----------
    writer : RasterWriter
        Writer of the output rasters. Its grid is aligned to the block edges to whole cells.
    bucketed : BucketedPoints
        The points on disk.
    options : Options
        How points become rasters.
    executor : Executor
        Runs one worker call per block.
    log : Callable[[str], None]
        Called with a line of progress: the number of blocks.

    Raises
    ------
    ConfigError
        If the disk is full, or a worker dies.
    TaskError
        If a block would not fit in memory.
    """
    jobs = list(_jobs(writer, bucketed, options))
    _check_memory(jobs)
    log(f"{count(len(jobs), 'block')} of {bucketed.buckets.edge:g} m")
    finished = executor.map(_rasterise_block, jobs, _fail)
    for job in track(finished, "making rasters", len(jobs), console=Console(stderr=True)):
        _write_block(writer, job)


def _jobs(writer: RasterWriter, bucketed: BucketedPoints, options: Options) -> Iterator[_BlockJob]:
    """Yield the blocks whose rasters can depend on points."""
    buckets, reach = bucketed.buckets, reach_m(options, writer.grid.cell)
    # Points sampled from a mesh have no colours: the orthophoto is drawn from its texture.
    dop_cell = writer.photo_grid.cell if writer.photo_grid and any(bucketed.has_colours) else None
    for index in buckets.overlapping(writer.grid):
        grid = _block_grid(writer.grid, buckets.edge, index)
        if grid and not bucketed.occupied.isdisjoint(buckets.overlapping(grid, reach)):
            yield _BlockJob(buckets, grid, options, dop_cell, writer.scratch / f"{index[0]}_{index[1]}.npz")


def _check_memory(jobs: Sequence[_BlockJob]) -> None:
    """Check that each block with its rim fits in memory.

    Raises
    ------
    TaskError
        If a block has too many points or cells.
    """
    counts: dict[BlockIndex, int] = {}
    for job in jobs:
        reach = reach_m(job.options, job.grid.cell)
        rim, points = job.grid.buffered(reach), 0.0
        for index in job.buckets.overlapping(job.grid, reach):
            if index not in counts:
                counts[index] = job.buckets.count(index)
            # The points of a block may lie anywhere in it; of its neighbours only the rim is kept.
            is_whole = job.buckets.share(index, job.grid.bounds) > 0
            points += counts[index] * (1 if is_whole else job.buckets.share(index, rim.bounds))
        cells = float(rim.width * rim.height)
        pixels = cells * (rim.cell / job.dop_cell) ** 2 if job.dop_cell else 0
        memory.check(
            POINT_BYTES * points + CELL_BYTES * cells + PIXEL_BYTES * pixels,
            f"block {job.grid.west:.0f}_{job.grid.south:.0f}, {points:,.0f} points and {cells:,.0f} cells,",
            "thin the points, or use larger cells (--cell, --dop-cell)",
        )


def _block_grid(whole: Grid, edge: float, index: BlockIndex) -> Grid | None:
    """Return the cells of a block that are part of the complete grid, or None if there are none."""
    left, right = (round((index[0] * edge + d - whole.west) / whole.cell) for d in (0, edge))
    top, bottom = (round((whole.north - index[1] * edge - d) / whole.cell) for d in (edge, 0))
    left, right = max(left, 0), min(right, whole.width)
    top, bottom = max(top, 0), min(bottom, whole.height)
    if left >= right or top >= bottom:
        return None
    west, north = whole.west + left * whole.cell, whole.north - top * whole.cell
    return Grid(whole.crs, west, north, whole.cell, right - left, bottom - top)


def _rasterise_block(job: _BlockJob) -> _BlockJob:
    reach = reach_m(job.options, job.grid.cell)
    points = job.buckets.read(job.grid, reach, with_colours=job.dop_cell is not None)
    rasters = rasterise(points, job.grid, job.options, job.dop_cell)
    top = rasters.top
    layers = {"dsm": rasters.dsm, "dtm": rasters.dtm}
    layers["road_height"] = np.stack([top.height, top.count, top.spread])
    if rasters.bridges is not None:
        layers["bridges"] = rasters.bridges
    arrays: dict[str, NDArray[Any]] = {name: heights.astype(np.float32) for name, heights in layers.items()}
    arrays[GROUND] = rasters.ground
    photo = {"colour": rasters.photo.colour, "known": rasters.photo.known} if rasters.photo else {}
    with disk_errors(job.target.parent.parent):
        np.savez(job.target, allow_pickle=False, **arrays, **photo)
    return job


def _fail(job: _BlockJob, reason: str) -> _BlockJob:
    raise ConfigError(f"block {job.grid.west:.0f}_{job.grid.south:.0f}: {reason}; use fewer workers")


def _write_block(writer: RasterWriter, job: _BlockJob) -> None:
    with np.load(job.target) as rasters:
        for layer in ("dsm", "dtm", "road_height", "bridges", GROUND):
            if layer in rasters:
                writer.write(layer, job.grid, rasters[layer])
        if "colour" in rasters and job.dop_cell:
            pixels = Grid.covering(job.grid.crs, job.grid.bounds, job.dop_cell)
            writer.write_photo(Orthophoto(pixels, rasters["colour"], rasters["known"]))
    job.target.unlink()
