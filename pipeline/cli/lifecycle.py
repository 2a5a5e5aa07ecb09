"""End of a ``run`` or ``rerun`` command: exit code and the result in one line."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass

from flexroad.catalog.text import count
from flexroad.pipeline.cli.signals import INTERRUPTED, signals_interrupt
from flexroad.pipeline.cli.stdio import echo
from flexroad.pipeline.run.summary import Summary


@dataclass
class Outcome:
    """Result of a command; filled in while it works."""

    exit_code: int = 0
    text: str = ""
    """The result in one line."""
    summary: Summary | None = None
    """The state of the run; None if no tile was processed."""


def format_summary(summary: Summary) -> str:
    """Return the state of a run in one line."""
    parts = [f"{summary.cached} cached"]
    if summary.without_roads:
        parts.append(f"{summary.without_roads} without roads")
    states = f"{summary.done} done ({', '.join(parts)}), {summary.failed} failed, {summary.pending} pending"
    changes = f"{summary.new} new, {summary.changed} changed, {summary.vanished} vanished"
    left_out = _left_out(summary)
    seconds = f"{summary.seconds:.0f} s{summary.to_look_at}"
    return f"{count(summary.tiles, 'tile')}: {states}; {changes}{left_out}; {seconds}"


def _left_out(summary: Summary) -> str:
    """Return what the catalog skipped for that line, empty if it is nothing."""
    if not summary.skipped:
        return ""
    lost = f", {count(summary.lost, 'tile')} lost" if summary.lost else ""
    return f"; {count(summary.skipped, 'file')} skipped by the catalog{lost}"


def warn(line: str, kind: str = "warning") -> None:
    """Print a line to standard error."""
    echo(f"{kind}: {line}", err=True)


@contextlib.contextmanager
def interruptible() -> Iterator[Outcome]:
    """Give the outcome of the block; an interruption is recorded in it and not raised again."""
    outcome = Outcome()
    try:
        with signals_interrupt():
            yield outcome
    except KeyboardInterrupt:
        outcome.exit_code = INTERRUPTED
        outcome.text = "interrupted; the same command goes on from here"
