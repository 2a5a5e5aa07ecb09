"""A tile counts as done only if its marker is in the run's folder."""

import json
import os
import shutil
from dataclasses import replace

import pandas as pd
import pytest

from flexroad.catalog import Catalog
from flexroad.pipeline.config.loading import compose
from flexroad.pipeline.execute import SerialExecutor
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.run.runner import run_tiles
from flexroad.pipeline.run.status import summary
from flexroad.pipeline.store.tables import read_metrics
from tests.builders import LIGHT
from tests.whole_run import assert_whole

GONE = "its results are missing: "


@pytest.fixture(scope="module")
def undisturbed(made_survey, tmp_path_factory):
    catalog = Catalog.read(made_survey / "catalog.parquet")
    run = Run.create(tmp_path_factory.mktemp("undisturbed") / "run", compose(LIGHT, "light"), catalog)
    run_tiles(run, SerialExecutor())
    return run.path


@pytest.fixture
def run(made_survey, tmp_path):
    catalog = Catalog.read(made_survey / "catalog.parquet")
    return Run.create(tmp_path / "run", compose(LIGHT, "light"), catalog)


class Disturbed(SerialExecutor):
    """Calls a function with the job of the n-th tile after it was processed, before its result is taken."""

    def __init__(self, n, disturb, change=lambda job: job):
        self.n, self.disturb, self.change = n, disturb, change

    def map(self, function, jobs, lost, probe=None):
        for number, job in enumerate(jobs):
            result = function(self.change(job))
            if number == self.n:
                self.disturb(job)
            yield result


def delete_folder_of(run, number):
    return lambda job: shutil.rmtree(run.folder(run.catalog.tiles[number].id).path)


def assert_missing(run, counts, number) -> str:
    """The tile is failed everywhere; return the message."""
    tile = run.catalog.tiles[number]
    assert (counts.done, counts.failed, counts.pending, counts.exit_code) == (3, 1, 0, 1)
    (failure,) = counts.failures
    assert (failure.tile_id, failure.kind) == (tile.id, "ResultsMissing")
    assert failure.file == str(run.folder(tile.id).path / "item.json")
    assert failure.message.startswith(GONE)
    assert failure.message.endswith("; run the same command again")
    links = json.loads((run.path / "collection.json").read_text())["links"]
    assert [link["title"] for link in links if link["rel"] == "item"] == [
        other.id for other in run.catalog.tiles if other != tile
    ]
    rows = read_metrics(run.path)
    assert set(rows[rows.status == "failed"].tile_id) == {tile.id}
    assert rows[rows.tile_id == tile.id].l2_road_m.isna().all()
    assert rows[rows.tile_id == tile.id].error.str.contains(GONE).all()
    again = summary(run)
    assert (again.done, again.failed) == (3, 1)
    return failure.message.removeprefix(GONE)


def test_tile_whose_folder_is_deleted_before_it_counts_is_failed(run, undisturbed):
    results = []
    counts = run_tiles(run, Disturbed(2, delete_folder_of(run, 2)), watch=results.append)
    assert [result.status for result in results] == ["done", "done", "failed", "done"]
    assert assert_missing(run, counts, 2).startswith("the folder was deleted, or ")
    assert run_tiles(run, SerialExecutor()).cached == 3
    assert_whole(run.path, undisturbed)


@pytest.mark.parametrize("tile", ["done", "cached"])
def test_tile_whose_folder_is_deleted_after_it_counted_is_failed(tile, run, undisturbed):
    if tile == "cached":
        run_tiles(run, SerialExecutor(), only=lambda tile: tile == run.catalog.tiles[0])
    counts = run_tiles(run, Disturbed(2, delete_folder_of(run, 0)))
    assert "its folder was deleted while the run worked" in assert_missing(run, counts, 0)
    assert run_tiles(run, SerialExecutor()).cached == 3
    assert_whole(run.path, undisturbed)


@pytest.mark.parametrize("earlier", [False, True], ids=["never done", "done before"])
def test_tile_that_a_worker_writes_elsewhere_is_failed(earlier, run, tmp_path):
    """As with another disk mounted there. The marker of an earlier result is not that of this one."""
    if earlier:
        run_tiles(
            Run.create(run.path, compose({**LIGHT, "ecsrc": "off"}, "other"), run.catalog), SerialExecutor()
        )
        run = Run.create(run.path, run.config, run.catalog)
    elsewhere = str(tmp_path / "elsewhere")
    one = run.catalog.tiles[1].id
    change = lambda job: replace(job, run=elsewhere) if job.graph.tile.id == one else job  # noqa: E731
    results = []
    counts = run_tiles(run, Disturbed(-1, None, change), watch=results.append)
    assert [result.status for result in results] == ["done", "failed", "done", "done"]
    (failure,) = results[1].failures
    assert failure.message.startswith(
        f"{GONE}the folder was deleted, or {os.uname().nodename} writes to another"
    )
    assert (counts.done, counts.failed, counts.exit_code) == (3, 1, 1)


def test_marker_with_another_time_counts(run, undisturbed):
    """As of a share that rounds times."""

    def touch(job):
        os.utime(job.folder.path / "item.json", (1, 1))

    assert run_tiles(run, Disturbed(1, touch)).done == 4
    pd.testing.assert_frame_equal(
        *(read_metrics(path).drop(columns="seconds") for path in (run.path, undisturbed)), check_exact=True
    )


def test_storage_that_does_not_answer_fails_the_tile_with_its_reason(run, monkeypatch):
    def refuse(*_):
        raise OSError(5, "Input/output error", "item.json")

    counts = run_tiles(
        run, Disturbed(0, lambda job: monkeypatch.setattr("flexroad.pipeline.run.status.marker_stat", refuse))
    )
    assert counts.failed == 4
    assert "missing (Input/output error): " in counts.failures[0].message
    monkeypatch.undo()
    assert run_tiles(run, SerialExecutor()).cached == 4
