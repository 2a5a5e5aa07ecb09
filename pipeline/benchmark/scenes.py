"""Write scenes of known truth as a prepared folder and its catalog."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from flexroad.catalog import Catalog, Grid, Tile
from flexroad.catalog.headers.vectors import opened, with_roads
from flexroad.catalog.sources import prepared
from flexroad.pipeline.benchmark.dsc3d import write_stand_in
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.execute import DaskExecutor, Executor, SerialExecutor
from flexroad.tasks.synthetic import SceneOptions, block, dsc3d, gerod, make_scene
from flexroad.tasks.synthetic.centrelines import CentreLine, centre_lines
from flexroad.tasks.synthetic.orthophoto import orthophoto

WORTH_PROCESSES = 12
"""Tiles from which on starting worker processes pays."""
PRESETS = ("gerod", "dsc3d")
TILES, SIZE_M = 4, 250
"""Number and side (m) of the tiles where nothing else is asked for."""
MADE = datetime(2025, 1, 1, tzinfo=UTC)
"""The made worlds' date: the same command gives the same files."""


@dataclass(frozen=True)
class SceneJob:
    """One tile to make."""

    folder: str
    tile_id: str
    grid: Grid
    seed: int
    stratum: str | None
    """None for a mix of districts."""
    options: SceneOptions
    name: str
    """What reports call the data."""
    dop: bool


def write_scenes(
    folder: Path,
    tiles: int | None,
    seed: int,
    size_m: int | None = None,
    dop: bool = False,
    preset: str | None = None,
) -> Path:
    """Make tiles, a block of neighbours or those of a preset; return the path of their catalog.

    Parameters
    ----------
    folder : Path
        Where they are written.
    tiles : int, optional
        How many; by default 4, or all of the preset.
    seed : int
        The world.
    size_m : int, optional
        Side of a tile (m); 250 by default. A preset's tiles have their own.
    dop : bool
        Whether orthophotos are made, too; the preset dsc3d always has them.
    preset : str, optional
        One of `PRESETS`.

    Raises
    ------
    ConfigError
        If the folder cannot be written, or the preset is unknown or has tiles of another size.
    """
    if preset == "dsc3d" and size_m in (None, dsc3d.SIZE_M):
        return write_stand_in(folder, tiles, seed)
    jobs = _jobs(folder, tiles, seed, size_m, dop, preset)
    executor: Executor = DaskExecutor() if len(jobs) >= WORTH_PROCESSES else SerialExecutor()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for error in executor.map(_write_scene, jobs, _lost):
            if error:
                raise ConfigError(error)
        path = folder / "catalog.parquet"
        wanted = {job.tile_id for job in jobs}
        found = prepared.index(folder)
        # A folder may hold more tiles than were asked for now.
        kept = [tile for tile in found if tile.id in wanted]
        Catalog(_with_roads(folder / "roads.gpkg", jobs, kept)).write(path)
    except OSError as error:
        raise ConfigError(f"cannot write scenes to {folder}: {error}") from error
    return path


def _jobs(
    folder: Path, tiles: int | None, seed: int, size_m: int | None, dop: bool, preset: str | None
) -> list[SceneJob]:
    if preset is None:
        name, plain = f"synthetic, seed {seed}", SceneOptions()
        places = [(*place, None, plain) for place in block(tiles or TILES, size_m or SIZE_M)]
        return [SceneJob(str(folder), t, grid, seed, s, o, name, dop) for t, grid, s, o in places]
    if preset not in PRESETS:
        raise ConfigError(f"--preset {preset}: there is {', '.join(PRESETS)}")
    own_m = {"gerod": gerod.SIZE_M, "dsc3d": dsc3d.SIZE_M}[preset]
    if size_m not in (None, own_m):
        raise ConfigError(f"--tile-size {size_m}: tiles of {preset} have {own_m} m; leave it out")
    name = f"synthetic benchmark {preset}, seed {seed}"
    return [
        SceneJob(str(folder), tile_id, grid, seed, stratum, options, name, dop)
        for tile_id, grid, stratum, options in gerod.survey(tiles or gerod.TILES, seed)
    ]


def _write_scene(job: SceneJob) -> str:
    asked = (job.grid, job.seed, job.stratum, job.options)
    scene = make_scene(*asked)
    layers = {**scene.layers, **({"dop": orthophoto(*asked)} if job.dop else {})}
    prepared.write_tile(Path(job.folder), job.tile_id, job.grid, layers, scene.stratum, MADE, job.name)
    return ""


def _with_roads(path: Path, jobs: Sequence[SceneJob], tiles: Sequence[Tile]) -> tuple[Tile, ...]:
    """Write the centre lines of all scenes into one file; return the tiles that name it."""
    path.unlink(missing_ok=True)
    # Neighbours of one world share their streets: by their places each line is written once.
    lines = {
        line.points.tobytes(): line
        for job in jobs
        for line in centre_lines(job.grid, job.seed, job.stratum, job.options)
    }
    if not lines:
        return tuple(tiles)
    _write_lines(path, list(lines.values()), jobs[0].grid.crs)
    return with_roads(tiles, [opened(path, None)], None)


def _write_lines(path: Path, lines: Sequence[CentreLine], crs: str) -> None:
    import geopandas
    import shapely

    temporary = path.with_name(f".{path.stem}.{os.getpid()}.tmp.gpkg")
    columns = {"highway": [line.highway for line in lines], "width_m": [line.width_m for line in lines]}
    shapes = [shapely.LineString(line.points) for line in lines]
    try:
        with _dated():
            geopandas.GeoDataFrame(columns, geometry=shapes, crs=crs).to_file(temporary, layer="roads")
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


@contextlib.contextmanager
def _dated() -> Iterator[None]:
    """Let GDAL write the made worlds' date instead of now."""
    import pyogrio

    pyogrio.set_gdal_config_options({"OGR_CURRENT_DATE": f"{MADE:%Y-%m-%dT%H:%M:%SZ}"})
    try:
        yield
    finally:
        pyogrio.set_gdal_config_options({"OGR_CURRENT_DATE": None})


def _lost(job: SceneJob, why: str) -> str:
    return f"scene {job.tile_id}: {why}"
