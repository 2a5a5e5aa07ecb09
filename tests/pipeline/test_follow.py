"""`flexroad status --watch`: a run seen from outside while it goes on."""

import io
import itertools
from dataclasses import replace

import pytest
from rich.console import Console

from flexroad.pipeline.monitor import live_status as followed
from flexroad.pipeline.monitor.live_status import Snapshot, follow
from flexroad.pipeline.run.lock import Holder, held
from flexroad.pipeline.store.database import NAME, Ledger
from flexroad.pipeline.store.records import Entry, Failure

ME = Holder("node7", "m", "b", 4711, 99, "2026-11-21T02:00:00+00:00", "t")
FIRST = Snapshot(when=0, tiles=10, done=4, cached=4, failed=0, holder=ME, failures=())


def test_it_tells_how_it_stands_how_fast_it_goes_and_who_is_at_work():
    now = replace(FIRST, when=120, done=7, failed=1)
    who = "pid 4711 on node7 at work since 2026-11-21T02:00:00+00:00"
    assert now.counts == "10 tiles: 7 done (4 cached), 1 failed, 2 pending"
    assert now.pace(FIRST) == f"{who}, 2.0 tiles a minute, about 1 min left"
    assert FIRST.pace(FIRST) == who
    assert replace(now, holder=None).pace(FIRST) == "no run goes on"


def test_a_run_is_seen_while_another_process_writes_it(tmp_path):
    with held(tmp_path), Ledger.open(tmp_path / NAME) as ledger:
        ledger.ask([(name, "pending") for name in "abc"])
        assert Snapshot.of(tmp_path).pending == 3
        ledger.record(Entry("b", "failed", "f", (), (Failure("b", "load", "TaskError", "gone"),)))
        ledger.record(Entry("c", "done", "f", ()))
        ledger.flush()
        now = Snapshot.of(tmp_path)
        assert (now.tiles, now.done, now.failed, now.pending) == (3, 1, 1, 1)
        assert now.failures == ("b: load: TaskError: gone",)
        assert now.holder is not None
    assert Snapshot.of(tmp_path).holder is None


@pytest.mark.parametrize("terminal", [True, False])
def test_it_goes_on_until_ctrl_c(terminal, monkeypatch, tmp_path):
    seen = [FIRST, replace(FIRST, done=5), replace(FIRST, done=6, failed=9, failures=("b: load: gone",))]
    looks = itertools.count()

    def look(run):
        assert run == tmp_path
        number = next(looks)
        if number == len(seen):
            raise KeyboardInterrupt
        return seen[number]

    monkeypatch.setattr(followed.Snapshot, "of", look)
    out = io.StringIO()
    with pytest.raises(KeyboardInterrupt):
        follow(tmp_path, Console(file=out, force_terminal=terminal, width=100), every_s=0)
    said = out.getvalue()
    assert "6 done" in said
    assert ("failed b: load: gone" in said) == terminal
    if not terminal:
        assert [line.split()[3] for line in said.splitlines()] == ["4", "5", "6"]
