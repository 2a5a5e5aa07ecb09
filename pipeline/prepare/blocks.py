"""From points in blocks to the rasters of a sheet, block by block."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track

from flexroad.catalog import Grid
from flexroad.catalog.grid import Bounds
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.execute import Executor
from flexroad.pipeline.prepare.sheet import GROUND, Sheet
from flexroad.pipeline.prepare.spool import Blocks, Place, Spooled, room
from flexroad.tasks.acquire.points.to_rasters import Options, rasterise, reach_m
from flexroad.tasks.types import Orthophoto


@dataclass(frozen=True)
class BlockJob:
    """One block to make rasters of."""

    blocks: Blocks
    grid: Grid
    options: Options
    dop_cell: float | None
    """Pixel of the orthophoto (m); None if there is none."""
    target: Path
    """Where the rasters go, ``.npz``."""


def sheet_grid(bounds: Bounds, crs: str, cell: float, step: float) -> Grid:
    """Return the smallest grid on multiples of ``step`` (m) that covers the bounds."""
    west, south, east, north = (side / step for side in bounds)
    west, south = math.floor(west) * step, math.floor(south) * step
    east, north = math.ceil(east) * step, math.ceil(north) * step
    return Grid.covering(crs, (west, south, max(east, west + step), max(north, south + step)), cell)


def fill(
    sheet: Sheet, spooled: Spooled, options: Options, executor: Executor, say: Callable[[str], None]
) -> None:
    """Write the rasters of all blocks into a sheet; a bar tells how far it is.

    Parameters
    ----------
    sheet : Sheet
        On multiples of the blocks' edge, give or take whole cells.
    spooled : Spooled
        The points.
    options : Options
        How points become rasters.
    executor : Executor
        Makes the blocks, one worker each.
    say : Callable[[str], None]
        Told how many there are.

    Raises
    ------
    ConfigError
        If the disk is full, or a worker dies.
    """
    jobs = list(_jobs(sheet, spooled, options))
    say(f"{len(jobs)} block{'s' * (len(jobs) != 1)} of {spooled.blocks.edge:g} m")
    made = executor.map(_make, jobs, _lost)
    for job in track(made, "making rasters", len(jobs), console=Console(stderr=True)):
        _enter(sheet, job)


def _jobs(sheet: Sheet, spooled: Spooled, options: Options) -> Iterator[BlockJob]:
    """Yield the blocks on the sheet that points can reach."""
    blocks, reach = spooled.blocks, reach_m(options, sheet.grid.cell)
    # Points of a mesh have no colours: its texture is drawn instead.
    dop_cell = sheet.photo_grid.cell if sheet.photo_grid and any(spooled.colours) else None
    for place in blocks.over(sheet.grid):
        grid = _on_sheet(sheet.grid, blocks.edge, place)
        if grid and not spooled.places.isdisjoint(blocks.over(grid, reach)):
            yield BlockJob(blocks, grid, options, dop_cell, sheet.scratch / f"{place[0]}_{place[1]}.npz")


def _on_sheet(sheet: Grid, edge: float, place: Place) -> Grid | None:
    """Return the cells of a block that lie on the sheet, or None."""
    left, right = (round((place[0] * edge + d - sheet.west) / sheet.cell) for d in (0, edge))
    top, bottom = (round((sheet.north - place[1] * edge - d) / sheet.cell) for d in (edge, 0))
    left, right = max(left, 0), min(right, sheet.width)
    top, bottom = max(top, 0), min(bottom, sheet.height)
    if left >= right or top >= bottom:
        return None
    west, north = sheet.west + left * sheet.cell, sheet.north - top * sheet.cell
    return Grid(sheet.crs, west, north, sheet.cell, right - left, bottom - top)


def _make(job: BlockJob) -> BlockJob:
    reach = reach_m(job.options, job.grid.cell)
    points = job.blocks.near(job.grid, reach, coloured=job.dop_cell is not None)
    rasters = rasterise(points, job.grid, job.options, job.dop_cell)
    layers = {"dsm": rasters.dsm, "dtm": rasters.dtm}
    if rasters.bridges is not None:
        layers["bridges"] = rasters.bridges
    arrays: dict[str, NDArray[Any]] = {name: heights.astype(np.float32) for name, heights in layers.items()}
    arrays[GROUND] = rasters.ground
    photo = {"colour": rasters.photo.colour, "known": rasters.photo.known} if rasters.photo else {}
    with room(job.target.parent.parent):
        np.savez(job.target, allow_pickle=False, **arrays, **photo)
    return job


def _lost(job: BlockJob, why: str) -> BlockJob:
    raise ConfigError(f"block {job.grid.west:.0f}_{job.grid.south:.0f}: {why}; take fewer workers")


def _enter(sheet: Sheet, job: BlockJob) -> None:
    with np.load(job.target) as made:
        for layer in ("dsm", "dtm", "bridges", GROUND):
            if layer in made:
                sheet.write(layer, job.grid, made[layer])
        if "colour" in made and job.dop_cell:
            pixels = Grid.covering(job.grid.crs, job.grid.bounds, job.dop_cell)
            sheet.write_photo(Orthophoto(pixels, made["colour"], made["known"]))
    job.target.unlink()
