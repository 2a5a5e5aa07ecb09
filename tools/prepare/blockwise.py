"""Rasters from points in buckets on disk, made block by block and in parallel."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track

from flexroad.catalog import Grid
from flexroad.catalog.text import count
from flexroad.pipeline.execute import Executor
from flexroad.tasks import memory
from flexroad.tasks.types import Floats, Orthophoto
from flexroad.tools.prepare.output import disk_errors, on_failure
from flexroad.tools.prepare.point_buckets import BlockIndex, PointBuckets
from flexroad.tools.prepare.point_reading import BucketedPoints
from flexroad.tools.prepare.points.to_rasters import (
    CELL_LAYERS,
    GROUND,
    Options,
    cells_reach_m,
    of_cells,
    of_points,
    points_reach_m,
)
from flexroad.tools.prepare.raster_writer import RasterWriter

POINT_BYTES, CELL_BYTES, PIXEL_BYTES = 200, 200, 20
"""Memory that a block takes per point, cell and pixel of the orthophoto (bytes); measured."""


@dataclass(frozen=True)
class _PointsJob:
    """The input of a worker call that reads the points of a block."""

    buckets: PointBuckets
    """The buckets that overlap the block and its rim."""
    grid: Grid
    """Cells of the block."""
    options: Options
    pixels: Grid | None
    """Pixels of the orthophoto; None without an orthophoto."""
    target: Path
    """Output file, ``.npz``: the heights of the cells and the orthophoto."""


@dataclass(frozen=True)
class _CellsJob:
    """The input of a worker call that makes the rasters of a block from the heights of cells."""

    grid: Grid
    """Cells of the block."""
    options: Options
    sources: tuple[tuple[Grid, Path], ...]
    """Outputs of `_PointsJob` on the block and on the rim around it."""
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

    The points of each block are read first. The rasters of a block then need only cells, also around it.

    - `writer`: writer of the output rasters. Its grid is aligned to the block edges to whole cells.
    - `bucketed`: the points on disk; they are removed at the end.
    - `executor`: runs two worker calls per block.
    """
    first = list(_points_jobs(writer, bucketed, options))
    second = list(_cells_jobs(writer, bucketed, options, first))
    _check_memory(first, second)
    log(f"{count(len(second), 'block')} of {bucketed.buckets.edge:g} m")
    fail = on_failure(lambda job: f"block {job.grid.west:.0f}_{job.grid.south:.0f}")
    read = executor.map(_read_points, first, fail)
    for points_job in track(read, "reading points", len(first), console=Console(stderr=True)):
        if points_job.pixels:
            with np.load(points_job.target) as file:
                writer.write_photo(Orthophoto(points_job.pixels, file["colour"], file["known"]))
    bucketed.buckets.remove()
    made = executor.map(_make_rasters, second, fail)
    for cells_job in track(made, "making rasters", len(second), console=Console(stderr=True)):
        with np.load(cells_job.target) as rasters:
            for layer, values in rasters.items():
                writer.write(layer, cells_job.grid, values)
        cells_job.target.unlink()


def _points_jobs(writer: RasterWriter, bucketed: BucketedPoints, options: Options) -> Iterator[_PointsJob]:
    """Yield the blocks near points."""
    buckets, whole = bucketed.buckets, writer.grid
    # Points sampled from a mesh have no colours: the orthophoto is drawn from its texture.
    dop_cell = writer.photo_grid.cell if writer.photo_grid and any(bucketed.has_colours) else None
    # A point on the eastern or southern border of the area is in a cell outside, whose height is used, too.
    wider = whole.buffered(whole.cell)
    for index in buckets.overlapping(wider):
        grid, inner = (_block_grid(part, buckets.edge, index) for part in (wider, whole))
        reach = points_reach_m(options, whole.cell)
        if grid and (near := buckets.around(grid, reach)).parts:
            pixels = Grid.covering(inner.crs, inner.bounds, dop_cell) if inner and dop_cell else None
            yield _PointsJob(near, grid, options, pixels, writer.scratch / f"{index[0]}_{index[1]}.npz")


def _cells_jobs(
    writer: RasterWriter, bucketed: BucketedPoints, options: Options, of_points: Sequence[_PointsJob]
) -> Iterator[_CellsJob]:
    """Yield the blocks whose rasters can depend on points."""
    buckets, cell = bucketed.buckets, writer.grid.cell
    reach, heights = cells_reach_m(options, cell), {job.target.stem: job for job in of_points}
    for index in buckets.overlapping(writer.grid):
        grid = _block_grid(writer.grid, buckets.edge, index)
        if not grid:
            continue
        around = [heights.get(f"{col}_{row}") for col, row in buckets.overlapping(grid, reach)]
        sources = tuple((job.grid, job.target) for job in around if job)
        if sources:
            target = writer.scratch / f"{index[0]}_{index[1]}.rasters.npz"
            yield _CellsJob(grid, options, sources, target)


def _check_memory(of_points: Sequence[_PointsJob], of_cells: Sequence[_CellsJob]) -> None:
    """Check that each block with its rim fits in memory."""
    counts: dict[BlockIndex, int] = {}
    for job in of_points:
        reach = points_reach_m(job.options, job.grid.cell)
        rim, points = job.grid.buffered(reach), 0.0
        for index in job.buckets.overlapping(job.grid, reach):
            if index not in counts:
                counts[index] = job.buckets.count(index)
            # The points of a block may lie anywhere in it; only the rim of its neighbours is kept.
            is_whole = job.buckets.share(index, job.grid.bounds) > 0
            points += counts[index] * (1 if is_whole else job.buckets.share(index, rim.bounds))
        pixels = job.pixels.width * job.pixels.height if job.pixels else 0
        _check_block(job.grid, points, float(rim.width * rim.height), pixels)
    for block in of_cells:
        rim = block.grid.buffered(cells_reach_m(block.options, block.grid.cell))
        _check_block(block.grid, 0.0, float(rim.width * rim.height), 0)


def _check_block(grid: Grid, points: float, cells: float, pixels: int) -> None:
    memory.check(
        POINT_BYTES * points + CELL_BYTES * cells + PIXEL_BYTES * pixels,
        f"block {grid.west:.0f}_{grid.south:.0f}, {points:,.0f} points and {cells:,.0f} cells,",
        "thin the points, or use larger cells (--cell, --dop-cell)",
    )


def _block_grid(whole: Grid, edge: float, index: BlockIndex) -> Grid | None:
    """Return the cells of a block that are part of the complete grid; None if the block is outside."""
    left, right = (round((index[0] * edge + d - whole.west) / whole.cell) for d in (0, edge))
    top, bottom = (round((whole.north - index[1] * edge - d) / whole.cell) for d in (edge, 0))
    left, right = max(left, 0), min(right, whole.width)
    top, bottom = max(top, 0), min(bottom, whole.height)
    if left >= right or top >= bottom:
        return None
    return whole.part(slice(top, bottom), slice(left, right))


def _read_points(job: _PointsJob) -> _PointsJob:
    reach = points_reach_m(job.options, job.grid.cell)
    points = job.buckets.read(job.grid, reach, with_colours=job.pixels is not None)
    cells, photo = of_points(points, job.grid, job.options, job.pixels)
    arrays: dict[str, NDArray[Any]] = {"cells": cells}
    if photo:
        arrays |= {"colour": photo.colour, "known": photo.known}
    _save(job.target, arrays)
    return job


def _make_rasters(job: _CellsJob) -> _CellsJob:
    rim = job.grid.buffered(cells_reach_m(job.options, job.grid.cell))
    layers = of_cells(_cells(job.sources, rim), rim, job.grid, job.options)
    floats = {name: part.astype(np.float32) for name, part in layers.items() if name != GROUND}
    _save(job.target, floats | {GROUND: layers[GROUND]})
    return job


def _cells(sources: Sequence[tuple[Grid, Path]], rim: Grid) -> Floats:
    """Return `CELL_LAYERS` of several blocks on one grid; cells outside of all blocks have no points."""
    layers = np.full((len(CELL_LAYERS), *rim.shape), np.nan)
    # The layer with the number of points of the top layer.
    layers[2] = 0
    for grid, path in sources:
        with np.load(path) as file:
            cells = file["cells"]
        east, north = grid.west - rim.west, grid.north - rim.north
        left, top = round(east / rim.cell), round(-north / rim.cell)
        columns = slice(max(left, 0), min(left + grid.width, rim.width))
        rows = slice(max(top, 0), min(top + grid.height, rim.height))
        part = cells[:, rows.start - top : rows.stop - top, columns.start - left : columns.stop - left]
        layers[:, rows, columns] = part
        layers[4, rows, columns] += east
        layers[5, rows, columns] += north
    return layers


def _save(target: Path, arrays: Mapping[str, NDArray[Any]]) -> None:
    with disk_errors(target.parent.parent):
        np.savez(target, allow_pickle=False, **arrays)
