"""Write scenes of known truth as a prepared folder and its catalog."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from catalog import Catalog, Grid
from catalog.sources import prepared
from pipeline.errors import ConfigError
from pipeline.execute import DaskExecutor, Executor, SerialExecutor
from tasks.synthetic import block, make_scene
from tasks.synthetic.orthophoto import orthophoto

WORTH_PROCESSES = 12
"""Tiles from which on starting worker processes pays."""
MADE = datetime(2025, 1, 1, tzinfo=UTC)
"""The made worlds' date: the same command gives the same files."""


@dataclass(frozen=True)
class SceneJob:
    """One tile to make."""

    folder: str
    tile_id: str
    grid: Grid
    seed: int
    dop: bool


def write_scenes(folder: Path, tiles: int, seed: int, size_m: int = 250, dop: bool = False) -> Path:
    """Make a block of tiles of ``size_m``, with orthophotos if asked; return the path of its catalog.

    Raises
    ------
    ConfigError
        If the folder cannot be written.
    """
    jobs = [SceneJob(str(folder), tile_id, grid, seed, dop) for tile_id, grid in block(tiles, size_m)]
    executor: Executor = DaskExecutor() if tiles >= WORTH_PROCESSES else SerialExecutor()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for error in executor.map(_write_scene, jobs, _lost):
            if error:
                raise ConfigError(error)
        path = folder / "catalog.parquet"
        wanted = {job.tile_id for job in jobs}
        found = prepared.index(folder)
        # A folder may hold more tiles than were asked for now.
        Catalog(tuple(tile for tile in found if tile.id in wanted)).write(path)
    except OSError as error:
        raise ConfigError(f"cannot write scenes to {folder}: {error}") from error
    return path


def _write_scene(job: SceneJob) -> str:
    scene = make_scene(job.grid, job.seed)
    layers = {**scene.layers, **({"dop": orthophoto(job.grid, job.seed)} if job.dop else {})}
    prepared.write_tile(Path(job.folder), job.tile_id, job.grid, layers, scene.stratum, MADE, _name(job))
    return ""


def _name(job: SceneJob) -> str:
    """Return what reports call the data."""
    return f"synthetic, seed {job.seed}"


def _lost(job: SceneJob, why: str) -> str:
    return f"scene {job.tile_id}: {why}"
