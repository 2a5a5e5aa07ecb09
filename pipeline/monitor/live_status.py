"""``flexroad status --watch``: look at a run while it goes on, from another terminal, without touching it."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import datetime
from itertools import islice

from rich.console import Console, Group
from rich.live import Live
from rich.padding import Padding
from rich.progress_bar import ProgressBar
from rich.text import Text

from flexroad.catalog.storage.paths import Place
from flexroad.pipeline.run.lock import Holder, at_work, holder
from flexroad.pipeline.store.database import NAME as LEDGER
from flexroad.pipeline.store.database import Ledger

SHOWN = 5
"""Failures that are named."""


@dataclass(frozen=True)
class Snapshot:
    """A run at a moment, as its ledger has it."""

    when: float
    tiles: int
    done: int
    """Tiles with results, those of earlier runs included."""
    cached: int
    failed: int
    holder: Holder | None
    """Which process is at work."""
    failures: tuple[str, ...]

    @classmethod
    def of(cls, run: Place) -> Snapshot:
        """Look at a run."""
        with Ledger.peek(run / LEDGER) as ledger:
            counts = ledger.counts()
            failures = tuple(failure.notice for failure in islice(ledger.failures(), SHOWN))
        return cls(
            time.time(),
            counts.total(),
            counts["done"] + counts["cached"],
            counts["cached"],
            counts["failed"],
            holder(run),
            failures,
        )

    @property
    def pending(self) -> int:
        """Tiles that are still to do."""
        return self.tiles - self.done - self.failed

    @property
    def counts(self) -> str:
        """How the tiles stand."""
        now = f"{self.done} done ({self.cached} cached), {self.failed} failed, {self.pending} pending"
        return f"{self.tiles} tiles: {now}"

    def pace(self, first: Snapshot) -> str:
        """Tell who is at work, and how fast it goes since an earlier look."""
        if self.holder is None:
            return "no run goes on"
        who = at_work(self.holder)
        minutes, tried = (self.when - first.when) / 60, first.pending - self.pending
        if tried <= 0 or minutes <= 0:
            return who
        left = self.pending / (tried / minutes)
        return f"{who}, {tried / minutes:.1f} tiles a minute, about {left:.0f} min left"


def follow(run: Place, console: Console, every_s: float) -> None:
    """Show how a run goes until Ctrl-C: alive on a terminal, else line by line."""
    seen = _snapshots(run, every_s)
    first = next(seen)
    if not console.is_terminal:
        for now in seen:
            stamp = datetime.fromtimestamp(now.when).astimezone().isoformat(timespec="seconds")
            text = f"{stamp} {now.counts}; {now.pace(first)}"
            console.print(text, markup=False, highlight=False, soft_wrap=True)
        return
    with Live(_shown(first, first), console=console) as live:
        for now in seen:
            live.update(_shown(now, first))


def _snapshots(run: Place, every_s: float) -> Iterator[Snapshot]:
    # The first one twice: it is shown at once, and tells how fast those after it go.
    yield (first := Snapshot.of(run))
    yield first
    while True:
        time.sleep(every_s)
        yield Snapshot.of(run)


def _shown(now: Snapshot, first: Snapshot) -> Group:
    lines = [now.counts, now.pace(first), *(f"  failed {failure}" for failure in now.failures)]
    if now.failed > len(now.failures):
        lines.append("  ...; flexroad status names them all")
    text = [Text(line, overflow="ellipsis", no_wrap=True) for line in lines]
    # A bar by itself ends no line.
    bar = Padding(ProgressBar(max(1, now.tiles), now.tiles - now.pending), 0)
    return Group(bar, *text)
