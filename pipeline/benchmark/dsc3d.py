"""Write the stand-in for DSC3D: synthetic meshes and the rasters of ``prepare mesh``, in two catalogs.

The folder of a scene contains ``mesh.glb``, its true layers (``known/<layer>/<scene>.tif``), and the rasters
and catalog that ``prepare mesh`` writes. In the folder above, ``catalog.parquet`` lists all scenes with the
reference that the paper describes, and ``catalog_true.parquet`` lists them with the true reference.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path

from flexroad.catalog import Catalog, Tile
from flexroad.catalog.sources import prepared
from flexroad.catalog.storage.paths import write
from flexroad.pipeline.benchmark.truth import CATALOG, KNOWN, with_truth
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.execute import Executor, SerialExecutor
from flexroad.pipeline.prepare.mesh import POINTS, MeshOptions, prepare_mesh
from flexroad.pipeline.prepare.options import PrepareOptions
from flexroad.tasks.synthetic import dsc3d
from flexroad.tasks.synthetic.dsc3d import Place
from flexroad.tasks.synthetic.photogrammetry import encode, photogrammetry

MADE = datetime(2025, 1, 1, tzinfo=UTC)
"""Date of the data; fixed, so that the same command writes the same files."""
NAME = "synthetic photogrammetry, stand-in for DSC3D, seed {}"
TRUE = "true reference"


@dataclass(frozen=True)
class _Job:
    """One scene to write."""

    folder: str
    place: Place
    seed: int


def write_stand_in(folder: Path, scenes: int | None, seed: int, executor: Executor | None = None) -> Path:
    """Write the scenes and their rasters; return the path of the catalog with the paper's reference.

    Parameters
    ----------
    folder : Path
        Output folder.
    scenes : int, optional
        Number of scenes; all five if None.
    seed : int
        Seed of the world.
    executor : Executor, optional
        Executor of the scenes; this process if None.

    Raises
    ------
    ConfigError
        If ``scenes`` is too large, a scene fails, or the folder cannot be written.
    """
    available = len(dsc3d.SITES)
    if scenes is not None and scenes > available:
        raise ConfigError(
            f"--tiles {scenes}: dsc3d has {available} scenes; leave --tiles out for all of them"
        )
    places = dsc3d.survey(scenes or available, seed)
    jobs = [_Job(str(folder), place, seed) for place in places]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for error in (executor or SerialExecutor()).map(_write_scene, jobs, _failure):
            if error:
                raise ConfigError(error)
        tiles = [_tile(folder, place) for place in places]
        true = f"{NAME.format(seed)}; {TRUE}"
        Catalog(tuple(with_truth(tile, f"{tile.id}/{KNOWN}", true) for tile in tiles)).write(folder / CATALOG)
        Catalog(tuple(tiles)).write(folder / "catalog.parquet")
    except OSError as error:
        raise ConfigError(f"cannot write scenes to {folder}: {error}") from error
    return folder / "catalog.parquet"


def _write_scene(job: _Job) -> str:
    scene = photogrammetry(job.place, job.seed)
    folder = Path(job.folder) / scene.name
    truth = scene.truth
    layers = {
        "road_mask": truth.road_mask,
        "reference": truth.reference,
        "reference_road": truth.reference_road,
    }
    name = NAME.format(job.seed)
    prepared.write_tile(folder / KNOWN, scene.name, truth.grid, layers, truth.stratum, MADE, name)
    write(folder / "mesh.glb", encode(scene.mesh))
    roads = folder / KNOWN / "road_mask" / f"{scene.name}.tif"
    options = PrepareOptions(roads=roads, date=MADE, dataset=name)
    prepare_mesh(
        folder / "mesh.glb", folder, options, MeshOptions(), POINTS, SerialExecutor(), lambda _: None
    )
    return ""


def _failure(job: _Job, reason: str) -> str:
    return f"scene {job.place.site.name}: {reason}"


def _tile(folder: Path, place: Place) -> Tile:
    """Return the tile of a scene with paths relative to the folder above."""
    name = place.site.name
    (tile,) = Catalog.read(folder / name / "catalog.parquet").tiles
    tile = tile.renamed(lambda file: f"{name}/{Path(file).name}")
    return replace(tile, id=name, root=str(folder.resolve()), stratum=place.site.stratum)
