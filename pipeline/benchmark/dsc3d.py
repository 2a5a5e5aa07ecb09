"""Write the stand-in for DSC3D: made meshes, and what ``prepare mesh`` makes of them, in two catalogs.

A scene's folder holds ``mesh.glb``, what is known of it (``known/<layer>/<scene>.tif``), and the rasters and
the catalog of its own that ``prepare mesh`` writes. Above them ``catalog.parquet`` lists all scenes with the
reference that the paper describes, and ``catalog_true.parquet`` the same with the truth.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path

from flexroad.catalog import Catalog, Layer, Tile
from flexroad.catalog.sources import prepared
from flexroad.catalog.storage.paths import write
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.execute import Executor, SerialExecutor
from flexroad.tasks.synthetic import dsc3d, glb
from flexroad.tasks.synthetic.dsc3d import Place
from flexroad.tasks.synthetic.photogrammetry import photogrammetry

MADE = datetime(2025, 1, 1, tzinfo=UTC)
"""The same command gives the same files."""
NAME = "synthetic photogrammetry, stand-in for DSC3D, seed {}"
TRUE = "true reference"
KNOWN = "known"
"""Folder of a scene's truth and of the road mask with the errors of a segmentation."""


@dataclass(frozen=True)
class _Job:
    """One scene to make."""

    folder: str
    place: Place
    seed: int


def write_stand_in(folder: Path, scenes: int | None, seed: int, executor: Executor | None = None) -> Path:
    """Make the scenes and their rasters; return the path of the catalog with the paper's reference.

    Parameters
    ----------
    folder : Path
        Where they are written.
    scenes : int, optional
        How many; by default all five.
    seed : int
        The world.
    executor : Executor, optional
        Where the scenes are made; by default in this process.

    Raises
    ------
    ConfigError
        If there are not so many scenes, one fails, or the folder cannot be written.
    """
    most = len(dsc3d.SITES)
    if scenes is not None and scenes > most:
        raise ConfigError(f"--tiles {scenes}: dsc3d has {most} scenes; leave it out for all")
    places = dsc3d.survey(scenes or most, seed)
    jobs = [_Job(str(folder), place, seed) for place in places]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for error in (executor or SerialExecutor()).map(_write_scene, jobs, _lost):
            if error:
                raise ConfigError(error)
        tiles = [_tile(folder, place) for place in places]
        Catalog(tuple(_with_truth(tile, seed) for tile in tiles)).write(folder / "catalog_true.parquet")
        Catalog(tuple(tiles)).write(folder / "catalog.parquet")
    except OSError as error:
        raise ConfigError(f"cannot write scenes to {folder}: {error}") from error
    return folder / "catalog.parquet"


def _write_scene(job: _Job) -> str:
    from flexroad.pipeline.prepare.mesh import POINTS, MeshOptions, prepare_mesh
    from flexroad.pipeline.prepare.options import PrepareOptions

    scene = photogrammetry(job.place, job.seed)
    home = Path(job.folder) / scene.name
    truth = scene.truth
    known = {
        "road_mask": truth.road_mask,
        "reference": truth.reference,
        "reference_road": truth.reference_road,
    }
    name = NAME.format(job.seed)
    prepared.write_tile(home / KNOWN, scene.name, truth.grid, known, truth.stratum, MADE, name)
    write(home / "mesh.glb", glb.encode(scene.mesh))
    roads = home / KNOWN / "road_mask" / f"{scene.name}.tif"
    options = PrepareOptions(roads=roads, date=MADE, dataset=name)
    prepare_mesh(home / "mesh.glb", home, options, MeshOptions(), POINTS, SerialExecutor(), lambda _: None)
    return ""


def _lost(job: _Job, why: str) -> str:
    return f"scene {job.place.site.name}: {why}"


def _tile(folder: Path, place: Place) -> Tile:
    """Return a scene's tile as one of the catalog above its folder."""
    name = place.site.name
    (tile,) = Catalog.read(folder / name / "catalog.parquet").tiles
    layers = tuple(
        replace(layer, files=tuple(f"{name}/{Path(file).name}" for file in layer.files))
        for layer in tile.layers
    )
    root = str(folder.resolve())
    return replace(tile, id=name, layers=layers, root=root, stratum=place.site.stratum)


def _with_truth(tile: Tile, seed: int) -> Tile:
    """Return the tile with the truth as reference of heights and roads."""
    layers = tuple(
        Layer(layer.name, (f"{tile.id}/{KNOWN}/{layer.name}/{tile.id}.tif",))
        if layer.name in ("reference", "reference_road")
        else layer
        for layer in tile.layers
    )
    return replace(tile, layers=layers, dataset=f"{NAME.format(seed)}; {TRUE}")
