"""The files of a run: after any damage the next run has the same tables and products."""

import os
import shutil
from pathlib import Path

import pandas as pd

from flexroad.catalog import Catalog, CatalogError
from flexroad.pipeline.config.loading import compose
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.execute import SerialExecutor
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.run.runner import run_tiles
from flexroad.pipeline.run.status import summary
from flexroad.pipeline.store.tables import read_metrics
from flexroad.tools.results.run import open_run
from flexroad.tools.synthetic.scenes import write_scenes
from tests.builders import LIGHT

EXPECTED = "expected"
NOT_DAMAGED = ("config.yaml", "lock.json", "failures.csv", "log.jsonl", "tiles.geojson")
"""Files that users may edit, that are written by every run, or that only people read."""


def make(folder: Path) -> list[Path]:
    os.environ["XDG_STATE_HOME"] = str(folder / "state")
    write_scenes(folder / "survey", 3, seed=3, size_m=40)
    run = _run(folder)
    shutil.copytree(run.path, folder / EXPECTED)
    files = (path for path in run.path.rglob("*") if path.is_file() and path.name not in NOT_DAMAGED)
    return sorted(files)


def copy(path: Path, folder: Path) -> Path:
    """Copy the run and its survey into a folder; return the path of one of its files there."""
    root = next(parent for parent in path.parents if (parent / EXPECTED).is_dir())
    shutil.copytree(root, folder, ignore=shutil.ignore_patterns(EXPECTED))
    (folder / EXPECTED).symlink_to(root / EXPECTED)
    return folder / path.relative_to(root)


def read(path: Path) -> None:
    """Read the damaged run, repair it, and compare it."""
    root = next(parent for parent in path.parents if (parent / EXPECTED).is_dir())
    os.environ["XDG_STATE_HOME"] = str(root / "state")
    error = None
    try:
        opened = open_run(root / "run")
        _same_tables(opened.metrics, read_metrics(root / EXPECTED))
        summary(opened.run)
    except (ConfigError, CatalogError) as caught:
        error = caught
    _run(root)
    _same_tables(read_metrics(root / "run"), read_metrics(root / EXPECTED))
    for product in (root / EXPECTED / "tiles").rglob("*_flexroad*"):
        again = root / "run" / product.relative_to(root / EXPECTED)
        assert again.read_bytes() == product.read_bytes(), f"{again} differs"
    if error:
        raise error


def _run(root: Path) -> Run:
    catalog = Catalog.read(root / "survey" / "catalog.parquet")
    run = Run.create(root / "run", compose(LIGHT | {"cluster": {"flush": False}}, "light"), catalog)
    counts = run_tiles(run, SerialExecutor(), verify=True)
    assert counts.done == len(catalog.tiles), counts
    return run


def _same_tables(found: pd.DataFrame, expected: pd.DataFrame) -> None:
    # Times and paths of a copy differ.
    columns = [name for name in expected if not name.endswith("_s") and "time" not in name]
    pd.testing.assert_frame_equal(found[columns].reset_index(drop=True), expected[columns])
