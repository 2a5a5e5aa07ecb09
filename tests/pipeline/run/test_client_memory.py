"""The memory of the client does not grow with the number of tiles that it has sent and recorded."""

import gc
import pickle
import tracemalloc
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path

import pytest

from flexroad.catalog import Catalog
from flexroad.pipeline.config.loading import load_config
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.run.runner import run_tiles
from flexroad.pipeline.store import database
from tests.made_result import done

TILES = 1500
BYTES_A_TILE = 60
"""Largest growth; a run of 550,000 tiles then grows by 33 MB."""


class Sent:
    """Sends every job as bytes, as Dask does, and returns a result at once; measures memory twice."""

    def __init__(self):
        self.traced = []

    def map(self, function, jobs, lost, probe=None):
        for number, job in enumerate(jobs):
            sent = pickle.loads(pickle.dumps(job))
            yield pickle.loads(pickle.dumps(done(sent)))
            if number in (TILES // 3, TILES - 10):
                gc.collect()
                self.traced.append(traced_bytes())


def traced_bytes() -> int:
    """Return the memory of this process, without tracemalloc's own."""
    snapshot = tracemalloc.take_snapshot().filter_traces([tracemalloc.Filter(False, tracemalloc.__file__)])
    return sum(trace.size for trace in snapshot.traces)


@pytest.mark.slow
@pytest.mark.soak("runs")
def test_memory_of_client_does_not_grow_with_tiles_done(made_survey, tmp_path):
    first = Catalog.read(made_survey / "catalog.parquet").tiles[0]
    west = [first.grid.west + number * first.grid.width * first.grid.cell for number in range(TILES)]
    Catalog(tuple(replace(first, id=f"tile_{e:.0f}", grid=replace(first.grid, west=e)) for e in west)).write(
        tmp_path / "catalog.parquet"
    )
    # Threads of other tests, of Dask for example, would be measured too.
    with ProcessPoolExecutor(1, get_context("spawn")) as own_process:
        before, after = own_process.submit(traced_run, tmp_path, first.root).result()
    assert (after - before) / (TILES * 2 / 3) < BYTES_A_TILE


def traced_run(folder: Path, root: Path) -> list[int]:
    """Return the memory (bytes) after a third of a run's tiles and near its end."""
    # Records wait up to a second for their common writing; that is not growth.
    database.FLUSH_S = -1
    run = Run.create(
        folder / "run", load_config("production"), Catalog.read(folder / "catalog.parquet", [root])
    )
    executor = Sent()
    tracemalloc.start()
    run_tiles(run, executor)
    tracemalloc.stop()
    return executor.traced
