"""Write synthetic scenes with known truth as a prepared folder and its catalog."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import shapely

from flexroad.catalog import Catalog, Grid, Tile
from flexroad.catalog.headers.vectors import opened, with_roads
from flexroad.catalog.lazy import lazy
from flexroad.catalog.sources import prepared
from flexroad.catalog.storage.outputs import output_file
from flexroad.pipeline.benchmark.dsc3d import write_stand_in
from flexroad.pipeline.benchmark.truth import CATALOG, KNOWN, with_truth
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.execute import AdaptiveExecutor, DaskExecutor, Jobs
from flexroad.tasks.io.vectors import vector_date
from flexroad.tasks.synthetic import SceneOptions, block, dsc3d, gerod, make_scene
from flexroad.tasks.synthetic.centrelines import CentreLine, centre_lines
from flexroad.tasks.synthetic.orthophoto import orthophoto

geopandas = lazy("geopandas")

PRESETS = ("gerod", "dsc3d")
TILES, SIZE_M = 4, 250
"""Default number and side (m) of the tiles."""
MADE = datetime(2025, 1, 1, tzinfo=UTC)
"""Date of the data; fixed, so that the same command writes the same files."""


@dataclass(frozen=True)
class SceneJob:
    """One tile to write."""

    folder: str
    tile_id: str
    grid: Grid
    seed: int
    stratum: str | None
    """None for a mix of districts."""
    options: SceneOptions
    name: str
    """Name of the dataset."""
    dop: bool
    """Whether to write an orthophoto."""
    extended_dtm: bool
    """Whether the reference is the DTM with bridges; the truth is then written to a folder of its own."""


def write_scenes(
    folder: Path,
    tiles: int | None,
    seed: int,
    size_m: int | None = None,
    dop: bool = False,
    preset: str | None = None,
) -> Path:
    """Write a block of neighbouring tiles, or the tiles of a preset; return the path of their catalog.

    The reference of a preset's tiles is the one that the paper describes. Beside their catalog,
    ``catalog_true.parquet`` lists them with the truth as reference.

    Parameters
    ----------
    folder : Path
        Output folder.
    tiles : int, optional
        Number of tiles; if None, 4, or all of the preset.
    seed : int
        Seed of the world.
    size_m : int, optional
        Side of a tile (m); 250 if None. The size of a preset's tiles is fixed.
    dop : bool
        Whether to write orthophotos; the preset dsc3d always has them.
    preset : str, optional
        One of `PRESETS`; None for a block of neighbouring tiles.

    Raises
    ------
    ConfigError
        If the folder cannot be written, or the preset is unknown or has tiles of another size.
    """
    if preset == "dsc3d" and size_m in (None, dsc3d.SIZE_M):
        return write_stand_in(folder, tiles, seed)
    jobs = _jobs(folder, tiles, seed, size_m, dop, preset)
    executor = AdaptiveExecutor(None, DaskExecutor(), lambda line: None)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        written = list[Tile]()
        for result in executor.map(_write_scene, Jobs(iter(jobs), len(jobs)), _failure):
            if isinstance(result, str):
                raise ConfigError(result)
            written.append(result)
        path = folder / "catalog.parquet"
        tiles_written = prepared.with_neighbours(written)
        catalog = Catalog(_with_roads(folder / "roads.gpkg", jobs, tiles_written))
        if preset:
            true = tuple(with_truth(tile, KNOWN, tile.dataset) for tile in catalog.tiles)
            Catalog(true).write(folder / CATALOG)
        catalog.write(path)
    except OSError as error:
        raise ConfigError(f"cannot write scenes to {folder}: {error}") from error
    return path


def _jobs(
    folder: Path, tiles: int | None, seed: int, size_m: int | None, dop: bool, preset: str | None
) -> list[SceneJob]:
    if preset is None:
        name, options = f"synthetic, seed {seed}", SceneOptions()
        return [
            SceneJob(str(folder), tile_id, grid, seed, None, options, name, dop, extended_dtm=False)
            for tile_id, grid in block(tiles or TILES, size_m or SIZE_M)
        ]
    if preset not in PRESETS:
        raise ConfigError(f"--preset {preset}: unknown, there are {', '.join(PRESETS)}")
    own_m = {"gerod": gerod.SIZE_M, "dsc3d": dsc3d.SIZE_M}[preset]
    if size_m not in (None, own_m):
        raise ConfigError(f"--tile-size {size_m}: tiles of {preset} have {own_m} m; leave --tile-size out")
    name = f"synthetic benchmark {preset}, seed {seed}"
    return [
        SceneJob(str(folder), tile_id, grid, seed, stratum, options, name, dop, extended_dtm=True)
        for tile_id, grid, stratum, options in gerod.survey(tiles or gerod.TILES, seed)
    ]


def _write_scene(job: SceneJob) -> Tile | str:
    arguments = (job.grid, job.seed, job.stratum, job.options)
    scene = make_scene(*arguments)
    layers = {**scene.layers, **({"dop": orthophoto(*arguments)} if job.dop else {})}
    folder, about = Path(job.folder), (scene.stratum, MADE, job.name)
    if job.extended_dtm:
        truth = {"reference": scene.reference, "reference_road": scene.reference_road}
        prepared.write_tile(folder / KNOWN, job.tile_id, job.grid, truth, *about)
        layers |= {"reference": scene.extended_dtm}
    return prepared.write_tile(folder, job.tile_id, job.grid, layers, *about)


def _with_roads(path: Path, jobs: Sequence[SceneJob], tiles: Sequence[Tile]) -> tuple[Tile, ...]:
    """Write the centre lines of all scenes to one file; return the tiles with it as layer ``roads``."""
    output_file(path).unlink(missing_ok=True)
    # Neighbouring tiles share streets; equal lines are written once.
    lines = {
        line.points.tobytes(): line
        for job in jobs
        for line in centre_lines(job.grid, job.seed, job.stratum, job.options)
    }
    if not lines:
        return tuple(tiles)
    _write_lines(path, list(lines.values()), jobs[0].grid.crs)
    return with_roads(tiles, [opened(path, None)], None)[0]


def _write_lines(path: Path, lines: Sequence[CentreLine], crs: str) -> None:
    target = output_file(path)
    temporary = path.with_name(f".{path.stem}.{os.getpid()}.tmp.gpkg")
    columns = {"highway": [line.highway for line in lines], "width_m": [line.width_m for line in lines]}
    shapes = [shapely.LineString(line.points) for line in lines]
    try:
        with vector_date(MADE):
            geopandas.GeoDataFrame(columns, geometry=shapes, crs=crs).to_file(temporary, layer="roads")
        temporary.replace(target)
    finally:
        temporary.unlink(missing_ok=True)


def _failure(job: SceneJob, reason: str) -> Tile | str:
    return f"scene {job.tile_id}: {reason}"
