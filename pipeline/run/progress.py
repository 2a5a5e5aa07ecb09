"""Progress of commands: a live display on a terminal, plain lines elsewhere."""

from __future__ import annotations

import contextlib
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from types import TracebackType
from typing import Any

from rich.console import Console, Group
from rich.live import Live
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    SpinnerColumn,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
    track,
)
from rich.text import Text

from flexroad.catalog.text import Notify, count, printable
from flexroad.pipeline.worker.tile import TileResult

FIRST_S = 1.0
"""Time after which the name of unfinished work is printed (s)."""
PLAIN_EVERY_S = 10.0
"""Shortest interval of plain progress lines (s)."""
SILENT_EVERY_S = 60.0
"""Interval of plain progress lines while there is no new result (s)."""


@contextlib.contextmanager
def said_repeatedly(line: Callable[[float], str], notify: Notify, wait_s: float) -> Iterator[None]:
    """Print a line if the block takes longer than ``wait_s``, and then every `PLAIN_EVERY_S`.

    - `line`: takes the time since the start of the block (s); an empty line is not printed.
    """
    ended, start = threading.Event(), time.monotonic()

    def speak() -> None:
        wait = wait_s
        while not ended.wait(wait):
            wait = PLAIN_EVERY_S
            if text := line(time.monotonic() - start):
                notify(text)

    speaker = threading.Thread(target=speak, daemon=True)
    speaker.start()
    try:
        yield
    finally:
        ended.set()
        speaker.join()


def step_progress(console: Console) -> Callable[[Iterable[Any], str, int], Iterator[Any]]:
    """Return a function that yields the items of a step and shows the number of done items.

    It shows a bar on a terminal, else plain lines if the step takes long. Its arguments are the items, the
    step (``checking tiles``) and the number of items.
    """

    def tracked(items: Iterable[Any], step: str, total: int) -> Iterator[Any]:
        if console.is_terminal:
            yield from track(items, step, total, console=console, transient=True)
            return
        done = 0

        def line(spent_s: float) -> str:
            return f"{step}: {done} of {total}, {spent_s:.0f} s spent"

        with said_repeatedly(line, lambda text: print_line(console, text), FIRST_S):
            for item in items:
                yield item
                done += 1

    return tracked


def print_line(console: Console, text: str) -> None:
    """Print one line; characters that cannot be printed are escaped."""
    # File names may contain markup characters, and paths must not be wrapped.
    console.print(printable(text), markup=False, highlight=False, soft_wrap=True)


class ProgressDisplay:
    """Shows counts of tiles by status and stage, and the remaining time; called with each tile result."""

    def __init__(self, total: int, console: Console) -> None:
        self.total = total
        self.console = console
        self.status: Counter[str] = Counter()
        self.stages: Counter[str] = Counter()
        self.without_roads = 0
        self.start = self.last_line = time.monotonic()
        self.told = -1
        """Number of results in the last plain line; -1 before the first one."""
        self.lock = threading.Lock()
        """Lock for the counts, because another thread prints plain lines."""
        self.progress = Progress(
            SpinnerColumn(),
            BarColumn(24),
            MofNCompleteColumn(),
            TextColumn("tiles,"),
            TimeElapsedColumn(),
            TextColumn("spent,"),
            TimeRemainingColumn(),
            TextColumn("left"),
            console=console,
        )
        self.bar = self.progress.add_task("tiles", total=total)
        # The counts have their own line: beside the bar there is too little space.
        self.counts_line = Text("  starting", overflow="ellipsis", no_wrap=True)
        self.stack = contextlib.ExitStack()
        self.live = (
            Live(Group(self.progress, self.counts_line), console=console) if console.is_terminal else None
        )

    def __enter__(self) -> ProgressDisplay:
        if self.live:
            self.live.start()
        else:
            # The first results may take minutes; a log or a pipe then gets plain lines.
            self.say(f"starting: {count(self.total, 'tile')}")
            self.stack.enter_context(said_repeatedly(self._due_line, self.say, PLAIN_EVERY_S))
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stack.close()
        if self.live:
            self.live.stop()

    def __call__(self, result: TileResult) -> None:
        """Add a tile's result."""
        with self.lock:
            self.status[result.status] += 1
            self.stages.update(result.computed)
            self.without_roads += result.entry.without_roads
        for failure in result.failures:
            self.say(f"failed {failure.notice}")
        self.progress.update(self.bar, advance=1)
        self.counts_line.plain = f"  {self.counts()}"

    def counts(self) -> str:
        """Return the counts of tiles by status and of computed results by stage."""
        parts = [f"{self.status[name]} {name}" for name in ("done", "cached", "failed")]
        if self.without_roads:
            parts.append(f"{self.without_roads} without roads")
        stages = " ".join(f"{stage}:{count}" for stage, count in self.stages.items())
        return ", ".join(parts) + (f" [{stages}]" if stages else "")

    def line(self) -> str:
        """Return the progress as one plain line."""
        tried = sum(self.status.values())
        spent = time.monotonic() - self.start
        tiles = count(self.total, "tile")
        if not tried:
            return f"0/{tiles}, no result yet, {spent:.0f} s spent"
        left = spent / tried * (self.total - tried)
        return f"{tried}/{tiles}, {self.counts()}, {spent:.0f} s spent, about {left:.0f} s left"

    def _due_line(self, _: float) -> str:
        """Return the plain line if there are new results or its time has come, else an empty text."""
        with self.lock:
            tried, now = sum(self.status.values()), time.monotonic()
            if tried == self.told and now - self.last_line < SILENT_EVERY_S:
                return ""
            self.told, self.last_line = tried, now
            return self.line()

    def say(self, text: str) -> None:
        """Print one line; characters that cannot be printed are escaped."""
        print_line(self.console, text)
