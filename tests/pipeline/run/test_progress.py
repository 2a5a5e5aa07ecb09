"""Progress in a log or a pipe: lines come without results, and agree with them."""

import io
import threading

import pytest
from rich.console import Console

from flexroad.pipeline.run import progress
from flexroad.pipeline.run.progress import ProgressDisplay, said_repeatedly, step_progress
from flexroad.pipeline.store.records import TileRecord
from flexroad.pipeline.worker.tile import TileResult

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
    monkeypatch.setattr(progress, "PLAIN_EVERY_S", 0.01)
    monkeypatch.setattr(progress, "FIRST_S", 0.01)
    return Log()


def test_work_that_takes_long_is_named_again_and_again(log):
    before = threading.active_count()
    with said_repeatedly(lambda _: "reading", lambda text: log.write(f"{text}\n"), 0.01):
        assert log.has("reading\nreading\n")
    assert threading.active_count() == before


def test_work_that_ends_at_once_is_not_named(log):
    with said_repeatedly(lambda _: "reading", lambda text: log.write(text), LONG_S):
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
    assert next(items) == "a"
    assert next(items) == "b"
    assert log.has("checking tiles: 1 of 3, ")
    assert list(items) == ["c"]


def test_step_on_a_terminal_has_a_bar(log):
    console = Console(file=log, force_terminal=True, width=80)
    assert list(step_progress(console)(range(3), "checking tiles", 3)) == [0, 1, 2]
    assert "checking tiles" in log.getvalue()
