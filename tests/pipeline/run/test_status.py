"""`flexroad status` of an active run: read by another process, without changing it."""

import re
from datetime import UTC, datetime, timedelta

import pytest

from flexroad.catalog import Catalog
from flexroad.pipeline.config.loading import compose, load_config
from flexroad.pipeline.graph.graph import Pattern
from flexroad.pipeline.run.lock import Owner, owner, run_lock
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.run.status import last_record, matches, progress
from flexroad.pipeline.store.database import NAME, RunDatabase
from flexroad.pipeline.store.products import TileProducts
from flexroad.pipeline.store.records import Failure, TileRecord
from tests.conftest import QUICK


@pytest.fixture
def run(made_survey, quick_config, tmp_path) -> Run:
    catalog = Catalog.read(made_survey / "catalog.parquet")
    return Run.create(tmp_path / "run", load_config(quick_config), catalog)


def test_progress_returns_counts_and_rate(run):
    now = datetime.now(UTC)
    one, two, three, _ = (tile.id for tile in run.catalog.tiles)
    holder = Owner(
        "node7", "m", "b", 4711, 99, (now - timedelta(minutes=2)).isoformat(timespec="seconds"), "t"
    )
    before, lately = ((now - timedelta(minutes=m)).isoformat(timespec="milliseconds") for m in (9, 1))
    with RunDatabase(run.path / NAME, writable=True) as database:
        database.set_states([(tile.id, "pending") for tile in run.catalog.tiles])
        database.record(TileRecord(one, "done", "f", (), finished=before))
        database.flush()
        database.set_states([(one, "cached"), *((tile.id, "pending") for tile in run.catalog.tiles[1:])])
        assert progress(run, holder)[1] == ""
        for name in (two, three):
            database.record(TileRecord(name, "done", "f", (), finished=lately))
        database.flush()
        summary, text = progress(run, holder)
    counts = (summary.tiles, summary.done, summary.cached, summary.failed, summary.pending)
    assert counts == (4, 3, 1, 0, 1)
    rate, left = map(float, re.fullmatch(r", (\S+) tiles a minute, about (\S+) min left", text).groups())
    assert rate == pytest.approx(1, abs=0.4)
    assert left == pytest.approx(1, abs=1)


def test_status_of_active_run_shows_counts_and_owner(run, flexroad):
    one, two, *_ = (tile.id for tile in run.catalog.tiles)
    with run_lock(run.path), RunDatabase(run.path / NAME, writable=True) as database:
        database.set_states([(tile.id, "pending") for tile in run.catalog.tiles])
        assert "4 tiles: 0 done (0 cached), 0 failed, 4 pending" in flexroad("status", run.path).out
        database.record(TileRecord(one, "failed", "f", (), (Failure(one, "load", "TaskError", "gone"),)))
        database.record(TileRecord(two, "done", "f", ()))
        database.flush()
        output = flexroad("status", run.path).out
        holder = owner(run.path)
        assert "4 tiles: 1 done (0 cached), 1 failed, 2 pending" in output
        assert f"pid {holder.pid} on {holder.host} at work since {holder.since}" in output
        assert f"  {one}: load: TaskError: gone" in output
    assert "at work" not in flexroad("status", run.path).out


def done(folder, graph) -> bool:
    files = folder.files()
    record = last_record(folder, None, files)
    return record is not None and record.state == "done" and matches(record, graph, files)


def test_tile_with_other_graph_or_incomplete_product_is_not_done(survey, tmp_path):
    graph = Pattern.of(compose(QUICK, "x")).graph(Catalog.read(survey).tiles[0])
    folder = TileProducts.of(tmp_path, graph.tile.id)
    item = {
        "id": graph.tile.id,
        "properties": {"flexroad:fingerprint": graph.fingerprint, "flexroad:rows": []},
        "assets": {"mesh": {"href": "mesh.glb", "file:size": 3}},
    }
    folder.finish(item, {"mesh.glb": b"abc"})
    assert done(folder, graph)
    (folder.path / "mesh.glb").write_bytes(b"ab")
    assert not done(folder, graph)
    (folder.path / "mesh.glb").write_bytes(b"abc")
    other = Pattern.of(compose({**QUICK, "sample": {"road_m": 2}}, "x")).graph(graph.tile)
    assert not done(folder, other)
    (folder.path / "item.json").write_text("{")
    assert not done(folder, graph)
