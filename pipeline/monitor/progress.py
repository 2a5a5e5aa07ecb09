"""Progress of a run: a live display on a terminal, plain lines elsewhere."""

from __future__ import annotations

import time
from collections import Counter
from types import TracebackType

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
)
from rich.text import Text

from flexroad.catalog.text import count, printable
from flexroad.pipeline.worker.tile import TileResult

PLAIN_EVERY_S = 10.0
"""Interval of plain progress lines (s)."""


class ProgressDisplay:
    """Shows counts of tiles by status and stage, and the remaining time; called with each tile result."""

    def __init__(self, total: int, console: Console) -> None:
        self.total = total
        self.console = console
        self.status: Counter[str] = Counter()
        self.stages: Counter[str] = Counter()
        self.without_roads = 0
        self.start = self.last_line = time.monotonic()
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
        self.live = (
            Live(Group(self.progress, self.counts_line), console=console) if console.is_terminal else None
        )

    def __enter__(self) -> ProgressDisplay:
        if self.live:
            self.live.start()
        else:
            # In a log, or a pipe, the first results may take minutes.
            self.say(f"starting: {count(self.total, 'tile')}")
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self.live:
            self.live.stop()

    def __call__(self, result: TileResult) -> None:
        """Add a tile's result."""
        self.status[result.status] += 1
        self.stages.update(result.computed)
        self.without_roads += result.entry.without_roads
        for failure in result.failures:
            self.say(f"failed {failure.notice}")
        self.progress.update(self.bar, advance=1)
        self.counts_line.plain = f"  {self.counts()}"
        if not self.live and time.monotonic() - self.last_line > PLAIN_EVERY_S:
            self.last_line = time.monotonic()
            self.say(self.line())

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
        left = spent / tried * (self.total - tried) if tried else float("nan")
        tiles = count(self.total, "tile")
        return f"{tried}/{tiles}, {self.counts()}, {spent:.0f} s spent, about {left:.0f} s left"

    def say(self, text: str) -> None:
        """Print one line; characters that cannot be printed are escaped."""
        # File names may contain markup characters, and paths must not be wrapped.
        self.console.print(printable(text), markup=False, highlight=False, soft_wrap=True)
