"""Runs whose tiles are fitted together, against runs of one tile after the other."""

from functools import partial

import numpy as np
import pandas as pd
import pytest

from flexroad.catalog import Catalog
from flexroad.pipeline.benchmark.scenes import write_scenes
from flexroad.pipeline.config.cluster import Cluster
from flexroad.pipeline.config.loading import load_config
from flexroad.pipeline.execute import BatchExecutor, DaskExecutor, SerialExecutor
from flexroad.pipeline.export.source import select
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.run.runner import run_tiles
from flexroad.pipeline.worker import batch
from flexroad.pipeline.worker.batch import fit_together, memory_of_batch, prepare
from flexroad.tasks.errors import TaskError
from flexroad.tasks.fit import smoothing_spline
from tests.dask_processes import wait_for
from tests.whole_run import rows

pytest.importorskip("torch")
pytestmark = pytest.mark.slow

TORCH = load_config("production", ["fit.engine=torch", "cluster.device=cpu", "cluster.flush=false"])


@pytest.fixture(scope="module")
def catalog(tmp_path_factory):
    folder = tmp_path_factory.mktemp("survey")
    return Catalog.read(write_scenes(folder, 4, seed=3, size_m=60))


@pytest.fixture(scope="module")
def single(catalog, tmp_path_factory):
    """A run of one tile after the other, with the engine of single tiles."""
    run = Run.create(tmp_path_factory.mktemp("single") / "run", load_config("production"), catalog)
    run_tiles(run, SerialExecutor())
    return run


def batched(executor=None):
    return BatchExecutor(executor or SerialExecutor(), prepare, partial(fit_together, TORCH.cluster), 3)


@pytest.fixture
def run(catalog, tmp_path):
    return Run.create(tmp_path / "run", TORCH, catalog)


def off_mm(first, second):
    """Return the largest difference of the surfaces of two runs (mm)."""
    differences = []
    for one, other in zip(select(first.path).finished(), select(second.path).finished(), strict=True):
        at = one.tile.grid.eastings, one.tile.grid.northings
        differences.append(np.abs(one.surface.lattice(*at) - other.surface.lattice(*at)).max())
    return 1e3 * max(differences)


def problems(run):
    return list((run.path / "store" / "problem").glob("*/*"))


def test_run_in_batches_equals_single_tiles_within_1_mm(run, single):
    seen = []
    summary = run_tiles(run, batched(), watch=seen.append)
    assert summary.done == 4
    assert off_mm(run, single) < 1
    assert not problems(run)
    assert all(result.computed["fit"] == 1 for result in seen)
    assert all(result.seconds["fit"] > 0 for result in seen)


def test_run_in_batches_on_dask_gives_the_same_rows(run, catalog, tmp_path, processes):
    processes.scheduler()
    processes.worker()
    processes.worker("--resources", "GPU=1")
    wait_for(processes.address, 2)
    summary = run_tiles(run, batched(DaskExecutor(scheduler=processes.address, gpu=True)))
    assert summary.done == 4
    serial = Run.create(tmp_path / "serial", TORCH, catalog)
    run_tiles(serial, batched())
    assert off_mm(run, serial) < 1e-3
    pd.testing.assert_frame_equal(rows(run.path), rows(serial.path), rtol=1e-3)


def test_resumed_run_takes_surfaces_of_batches_and_not_those_of_another_engine(run, single, catalog):
    run_tiles(run, batched())
    fits = {node.fingerprint for node in run.graph(catalog.tiles[0]).nodes.values() if node.stage == "fit"}
    others = {node.fingerprint for node in single.graph(catalog.tiles[0]).nodes.values()}
    assert not fits & others
    seen = []
    # The products again, without a batch: the surfaces are those of the store.
    run_tiles(run, SerialExecutor(), force=frozenset({"export"}), watch=seen.append)
    assert all("fit" not in result.computed for result in seen)


def test_batch_on_the_cpu_takes_at_most_half_of_its_worker():
    worker = Cluster(memory="600 MiB")
    assert memory_of_batch(worker, "cpu") == 300 * 1024**2
    assert memory_of_batch(worker, "cuda") == 2 * 1024**3
    assert memory_of_batch(Cluster(memory="600 MiB", batch_memory="1 GiB"), "cpu") == 1024**3


def test_batch_without_memory_is_halved(run, single, monkeypatch):
    solve, sizes = smoothing_spline.solve, []

    def with_little_memory(tiles, options, engine):
        sizes.append(len(tiles))
        if len(tiles) > 1:
            raise MemoryError("too many tiles")
        return solve(tiles, options, engine)

    monkeypatch.setattr(smoothing_spline, "solve", with_little_memory)
    assert run_tiles(run, batched()).done == 4
    assert sizes[:3] == [3, 1, 2]
    assert off_mm(run, single) < 1


def test_tile_that_cannot_be_fitted_is_a_failed_row_alone(run, catalog, monkeypatch):
    solve, bad = smoothing_spline.solve, catalog.tiles[1].grid

    def failing(tiles, options, engine):
        if any(tile.grid == bad for tile in tiles):
            raise TaskError("this tile fails")
        return solve(tiles, options, engine)

    monkeypatch.setattr(smoothing_spline, "solve", failing)
    summary = run_tiles(run, batched())
    assert (summary.done, summary.failed) == (3, 1)
    (failure,) = summary.failures
    assert (failure.tile_id, failure.stage, failure.message) == (
        catalog.tiles[1].id,
        "fit",
        "this tile fails",
    )
    assert not problems(run)


def test_tile_whose_preparation_fails_is_a_failed_row_alone(run, catalog, monkeypatch):
    prepare_fit, bad = batch._prepare_fit, catalog.tiles[2].id

    def failing(evaluator, node):
        if evaluator.graph.tile.id == bad:
            raise TaskError("no heights")
        return prepare_fit(evaluator, node)

    monkeypatch.setattr(batch, "_prepare_fit", failing)
    seen = []
    assert run_tiles(run, batched(), watch=seen.append).done == 4
    # This one was computed by itself.
    assert {result.tile_id for result in seen} == {tile.id for tile in catalog.tiles}


def test_forced_stages_are_computed_once(run):
    run_tiles(run, batched())
    seen = []
    forced = frozenset({"ecsrc", "border", "fit", "sample", "evaluate", "assess", "export"})
    run_tiles(run, batched(), force=forced, watch=seen.append)
    assert [result.computed["ecsrc"] for result in seen] == [1] * 4
    assert [result.computed["fit"] for result in seen] == [1] * 4
