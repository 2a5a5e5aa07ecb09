"""Progress of a run: lines in a log or a pipe, and `flexroad status`, which changes nothing."""

import io
import re
import threading
from datetime import UTC, datetime, timedelta

import pytest
from rich.console import Console

from flexroad.catalog import Catalog
from flexroad.pipeline.config.loading import compose
from flexroad.pipeline.graph.graph import Pattern
from flexroad.pipeline.run import progress as shown
from flexroad.pipeline.run.lock import Owner, owner, run_lock
from flexroad.pipeline.run.progress import ProgressDisplay, said_repeatedly, step_progress
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.run.status import last_record, matches, progress
from flexroad.pipeline.store.database import NAME, RunDatabase
from flexroad.pipeline.store.products import TileProducts
from flexroad.pipeline.store.records import Failure, TileRecord
from flexroad.pipeline.worker.tile import TileResult
from tests.builders import LIGHT


@pytest.fixture
def run(made_survey, tmp_path) -> Run:
    catalog = Catalog.read(made_survey / "catalog.parquet")
    return Run.create(tmp_path / "run", compose(LIGHT, "light"), catalog)


def test_progress_returns_counts_and_rate(run):
    now = datetime.now(UTC)
    one, two, three, _ = (tile.id for tile in run.catalog.tiles)
    since, before, lately = ((now - timedelta(minutes=m)).isoformat("T", "milliseconds") for m in (2, 9, 1))
    holder = Owner("node7", "m", "b", 4711, 99, since, "t")
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
        output, holder = flexroad("status", run.path).out, owner(run.path)
        assert "4 tiles: 1 done (0 cached), 1 failed, 2 pending" in output
        assert f"pid {holder.pid} on {holder.host} at work since {holder.since}" in output
        assert f"  {one}: load: TaskError: gone" in output
    assert "at work" not in flexroad("status", run.path).out


def test_tile_with_other_graph_or_incomplete_product_is_not_done(survey, tmp_path):
    def done(graph) -> bool:
        files = folder.files()
        record = last_record(folder, None, files)
        return record is not None and record.state == "done" and matches(record, graph, files)

    graph = Pattern.of(compose(LIGHT, "x")).graph(Catalog.read(survey).tiles[0])
    folder = TileProducts.of(tmp_path, graph.tile.id)
    item = {
        "id": graph.tile.id,
        "properties": {"flexroad:fingerprint": graph.fingerprint, "flexroad:rows": []},
        "assets": {"mesh": {"href": "mesh.glb", "file:size": 3}},
    }
    folder.finish(item, {"mesh.glb": b"abc"})
    assert done(graph)
    (folder.path / "mesh.glb").write_bytes(b"ab")
    assert not done(graph)
    (folder.path / "mesh.glb").write_bytes(b"abc")
    assert not done(Pattern.of(compose({**LIGHT, "sample": {"road_m": 2}}, "x")).graph(graph.tile))
    (folder.path / "item.json").write_text("{")
    assert not done(graph)


# --- lines of the command that works ------------------------------------------------------------------


LONG_S = 60.0
"""Time after which a test gives up."""


class Log(io.StringIO):
    """A stream that other threads can wait on."""

    def __init__(self) -> None:
        super().__init__()
        self.changed = threading.Condition()

    def write(self, text: str) -> int:
        with self.changed:
            self.changed.notify_all()
            return super().write(text)

    def has(self, text: str) -> bool:
        """Wait until a text is there."""
        with self.changed:
            return self.changed.wait_for(lambda: text in self.getvalue(), LONG_S)


@pytest.fixture
def log(monkeypatch) -> Log:
    for name in ("PLAIN_EVERY_S", "FIRST_S"):
        monkeypatch.setattr(shown, name, 0.01)
    return Log()


def test_work_that_takes_long_is_named_again_and_again(log):
    before = threading.active_count()
    with said_repeatedly(lambda _: "reading", lambda text: log.write(f"{text}\n"), 0.01):
        assert log.has("reading\nreading\n")
    assert threading.active_count() == before


def test_work_that_ends_at_once_is_not_named(log):
    with said_repeatedly(lambda _: "reading", log.write, LONG_S):
        pass
    assert log.getvalue() == ""


def test_run_without_results_speaks_in_a_pipe(log):
    result = TileResult(TileRecord("a", "done", "", ()), "done")
    with ProgressDisplay(2, Console(file=log)) as display:
        assert log.has("0/2 tiles, no result yet")
        display(result)
        assert log.has("1/2 tiles, 1 done, 0 cached, 0 failed")
        display(result)
        assert log.has("2/2 tiles, 2 done")
    lines = log.getvalue().splitlines()
    assert lines[0] == "starting: 2 tiles"
    # There is no line without news, until a minute has passed.
    assert len(lines) == 4


def test_step_in_a_pipe_says_how_many_are_done(log):
    items = step_progress(Console(file=log))(iter("abc"), "checking tiles", 3)
    assert [next(items), next(items)] == ["a", "b"]
    assert log.has("checking tiles: 1 of 3, ")
    assert list(items) == ["c"]


def test_step_on_a_terminal_has_a_bar(log):
    console = Console(file=log, force_terminal=True, width=80)
    assert list(step_progress(console)(range(3), "checking tiles", 3)) == [0, 1, 2]
    assert "checking tiles" in log.getvalue()
