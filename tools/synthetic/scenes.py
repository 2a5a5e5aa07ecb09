"""Write synthetic scenes with known truth as a prepared folder and its catalog."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal

import shapely

from flexroad.catalog import Catalog, Grid, Layer, Tile
from flexroad.catalog.lazy import lazy
from flexroad.catalog.scan.vectors import opened, with_roads
from flexroad.catalog.storage.outputs import output_file
from flexroad.catalog.storage.paths import write
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.execute import AdaptiveExecutor, DaskExecutor, Jobs, SerialExecutor
from flexroad.tasks.io.vectors import vector_date
from flexroad.tools.prepare.from_mesh import POINTS, MeshOptions, prepare_mesh
from flexroad.tools.prepare.options import PrepareOptions
from flexroad.tools.prepare.output import on_failure
from flexroad.tools.synthetic import SceneOptions, block, dsc3d, gerod, make_scene, prepared
from flexroad.tools.synthetic.crossings import CrossingOptions, Crossings, make_crossings
from flexroad.tools.synthetic.dsc3d import Place, encode, photogrammetry
from flexroad.tools.synthetic.orthophoto import orthophoto
from flexroad.tools.synthetic.scene import CentreLine, centre_lines

geopandas = lazy("geopandas")

Preset = Literal["gerod", "dsc3d"]
TILES, SIZE_M = 4, 250
"""Default number and side (m) of the tiles."""
MADE = datetime(2025, 1, 1, tzinfo=UTC)
"""Date of the data; fixed, so that the same command writes the same files."""
KNOWN = "known"
"""Folder of the true layers."""
TRUE_CATALOG = "catalog_true.parquet"
"""File of the second catalog: the same layers, with the true heights and roads as reference."""
TRUE_LAYERS = ("reference", "reference_road")
STAND_IN = "synthetic photogrammetry, stand-in for DSC3D, seed {}"
"""Name of the data of the preset dsc3d."""


@dataclass(frozen=True)
class _SceneJob:
    """One tile to write."""

    folder: str
    tile_id: str
    grid: Grid
    seed: int
    stratum: str | None
    """Stratum of all districts; None for a mix."""
    options: SceneOptions | CrossingOptions
    name: str
    """Name of the dataset."""
    dop: bool
    """Whether to write an orthophoto."""
    extended_dtm: bool
    """Whether the reference is the DTM with bridges; then the truth is written to another folder."""


def write_scenes(
    folder: Path,
    tiles: int | None,
    seed: int,
    size_m: int | None = None,
    dop: bool = False,
    preset: Preset | None = None,
    decks: bool = False,
) -> Path:
    """Write a block of neighbouring tiles, or the tiles of a preset; return the path of their catalog.

    With decks the true height of level N is the layer ``reference`` of the folder ``known/levelN``. Tiles of
    a preset have the reference that the paper describes. Next to their catalog, ``catalog_true.parquet``
    lists them with the truth as reference.

    - `tiles`: number of tiles; if None, 4, or all of the preset.
    - `size_m`: side of a tile (m); 250 if None. The size of a preset's tiles is fixed.
    - `dop`: whether to write orthophotos; the preset dsc3d always has them.
    - `preset`: None for a block of neighbouring tiles.
    - `decks`: whether the block has roads on decks and in tunnels (`tools.synthetic.crossings`).
    """
    if decks and (dop or preset):
        what = "--dop" if dop else f"--preset {preset}"
        raise ConfigError(f"--decks {what}: scenes with decks have no photos and no preset; leave {what} out")
    own_m = {"gerod": gerod.SIZE_M, "dsc3d": dsc3d.SIZE_M, None: size_m}[preset]
    if size_m not in (None, own_m):
        raise ConfigError(f"--tile-size {size_m}: tiles of {preset} have {own_m} m; leave --tile-size out")
    if preset == "dsc3d":
        return write_stand_in(folder, tiles, seed)
    jobs = _jobs(folder, tiles, seed, size_m, dop, preset, decks)
    executor = AdaptiveExecutor(None, DaskExecutor(), lambda line: None)
    fail = on_failure(lambda job: f"scene {job.tile_id}", "")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        written = list(executor.map(_write_scene, Jobs(iter(jobs), len(jobs)), fail))
        path = folder / "catalog.parquet"
        tiles_written = prepared.with_neighbours(written)
        catalog = Catalog(_with_roads(folder / "roads.gpkg", jobs, tiles_written))
        if preset:
            true = tuple(_with_truth(tile, KNOWN, tile.dataset) for tile in catalog.tiles)
            Catalog(true).write(folder / TRUE_CATALOG)
        catalog.write(path)
    except OSError as error:
        raise ConfigError(f"cannot write scenes to {folder}: {error}") from error
    return path


def _jobs(
    folder: Path,
    tiles: int | None,
    seed: int,
    size_m: int | None,
    dop: bool,
    preset: Preset | None,
    decks: bool,
) -> list[_SceneJob]:
    if preset is None:
        name = f"synthetic, seed {seed}"
        options = CrossingOptions() if decks else SceneOptions()
        return [
            _SceneJob(str(folder), tile_id, grid, seed, None, options, name, dop, extended_dtm=False)
            for tile_id, grid in block(tiles or TILES, size_m or SIZE_M)
        ]
    name = f"synthetic benchmark {preset}, seed {seed}"
    return [
        _SceneJob(str(folder), tile_id, grid, seed, stratum, options, name, dop, extended_dtm=True)
        for tile_id, grid, stratum, options in gerod.survey(tiles or gerod.TILES, seed)
    ]


def _write_scene(job: _SceneJob) -> Tile:
    if isinstance(job.options, CrossingOptions):
        scene = make_crossings(job.grid, job.seed, job.options)
        photo = {}
    else:
        arguments = (job.grid, job.seed, job.stratum, job.options)
        scene = make_scene(*arguments)
        photo = {"dop": orthophoto(*arguments)} if job.dop else {}
    layers = {**scene.layers, **photo}
    folder, about = Path(job.folder), (scene.stratum, MADE, job.name)
    for level, heights in scene.levels.items():
        prepared.write_tile(
            folder / KNOWN / f"level{level}", job.tile_id, job.grid, {"reference": heights}, *about
        )
    if job.extended_dtm:
        truth = {"reference": scene.reference, "reference_road": scene.reference_road}
        prepared.write_tile(folder / KNOWN, job.tile_id, job.grid, truth, *about)
        layers |= {"reference": scene.extended_dtm}
    return prepared.write_tile(folder, job.tile_id, job.grid, layers, *about)


def _with_roads(path: Path, jobs: Sequence[_SceneJob], tiles: Sequence[Tile]) -> tuple[Tile, ...]:
    """Write the centre lines of all scenes to one file; return the tiles with it as layer ``roads``."""
    output_file(path).unlink(missing_ok=True)
    # Neighbouring tiles share streets; equal lines are written once.
    lines = {line.points.tobytes(): line for job in jobs for line in _lines(job)}
    if not lines:
        return tuple(tiles)
    _write_lines(path, list(lines.values()), jobs[0].grid.crs)
    return with_roads(tiles, [opened(path, None)], None)[0]


def _lines(job: _SceneJob) -> list[CentreLine]:
    if isinstance(job.options, CrossingOptions):
        return Crossings(job.seed, job.options).roads(job.grid.bounds)
    return centre_lines(job.grid, job.seed, job.stratum, job.options)


def _write_lines(path: Path, lines: Sequence[CentreLine], crs: str) -> None:
    target = output_file(path)
    temporary = path.with_name(f".{path.stem}.{os.getpid()}.tmp.gpkg")
    columns: dict[str, list[Any]] = {
        "highway": [line.highway for line in lines],
        "width_m": [line.width_m for line in lines],
    }
    if any(line.level for line in lines):
        # OSM's tags of decks and tunnels, and the level as a number.
        columns |= {
            "bridge": ["yes" if line.level > 0 else None for line in lines],
            "tunnel": ["yes" if line.level < 0 else None for line in lines],
            "layer": [str(line.level) if line.level else None for line in lines],
            "level": [line.level for line in lines],
        }
    shapes = [shapely.LineString(line.points) for line in lines]
    try:
        with vector_date(MADE):
            geopandas.GeoDataFrame(columns, geometry=shapes, crs=crs).to_file(temporary, layer="roads")
        temporary.replace(target)
    finally:
        temporary.unlink(missing_ok=True)


def _with_truth(tile: Tile, folder: str, dataset: str) -> Tile:
    """Return a tile with the truth as reference, whose layers are in a folder relative to the tile's root."""
    layers = tuple(
        Layer(layer.name, (f"{folder}/{layer.name}/{tile.id}.tif",)) if layer.name in TRUE_LAYERS else layer
        for layer in tile.layers
    )
    return replace(tile, layers=layers, dataset=dataset)


def write_stand_in(folder: Path, scenes: int | None, seed: int) -> Path:
    """Write the replacement for DSC3D; return the path of the catalog with the paper's reference.

    The folder of a scene contains ``mesh.glb``, its true layers (``known/<layer>/<scene>.tif``), and the
    rasters and catalog of ``prepare``. The catalogs of all scenes are in the folder above.

    - `scenes`: number of scenes; all five if None.
    """
    available = len(dsc3d.SITES)
    if scenes is not None and scenes > available:
        raise ConfigError(
            f"--tiles {scenes}: dsc3d has {available} scenes; leave --tiles out for all of them"
        )
    places = dsc3d.survey(scenes or available, seed)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for place in places:
            _write_stand_in(folder, seed, place)
        tiles = [_stand_in_tile(folder, place) for place in places]
        true = f"{STAND_IN.format(seed)}; true reference"
        Catalog(tuple(_with_truth(tile, f"{tile.id}/{KNOWN}", true) for tile in tiles)).write(
            folder / TRUE_CATALOG
        )
        Catalog(tuple(tiles)).write(folder / "catalog.parquet")
    except OSError as error:
        raise ConfigError(f"cannot write scenes to {folder}: {error}") from error
    return folder / "catalog.parquet"


def _write_stand_in(parent: Path, seed: int, place: Place) -> None:
    scene = photogrammetry(place, seed)
    folder = parent / scene.name
    truth = scene.truth
    layers = {
        "road_mask": truth.road_mask,
        "reference": truth.reference,
        "reference_road": truth.reference_road,
    }
    name = STAND_IN.format(seed)
    prepared.write_tile(folder / KNOWN, scene.name, truth.grid, layers, truth.stratum, MADE, name)
    write(folder / "mesh.glb", encode(scene.mesh))
    roads = folder / KNOWN / "road_mask" / f"{scene.name}.tif"
    options = PrepareOptions(roads=roads, date=MADE, dataset=name)
    prepare_mesh(
        folder / "mesh.glb", folder, options, MeshOptions(), POINTS, SerialExecutor(), lambda _: None
    )


def _stand_in_tile(folder: Path, place: Place) -> Tile:
    """Return the tile of a scene with paths relative to the folder above."""
    name = place.site.name
    (tile,) = Catalog.read(folder / name / "catalog.parquet").tiles
    tile = tile.renamed(lambda file: f"{name}/{Path(file).name}")
    return replace(tile, id=name, root=str(folder.resolve()), stratum=place.site.stratum)
