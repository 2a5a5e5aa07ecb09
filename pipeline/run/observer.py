"""The events of a run, for whoever shows or records them."""

from __future__ import annotations

import contextlib
from contextlib import AbstractContextManager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from flexroad.pipeline.run.summary import Summary
    from flexroad.pipeline.worker.tile import TileResult


class Observer:
    """Takes the events of a run in their order; each method does nothing unless a subclass overrides it."""

    def working(self, work: str) -> AbstractContextManager[None]:
        """Enclose work before the first tile that may take long: ``reading survey.parquet``."""
        return contextlib.nullcontext()

    def note(self, text: str) -> None:
        """Take a remark in one line."""

    def warning(self, text: str) -> None:
        """Take a warning in one line: something that could not be done, and does not stop the run."""

    def start(self, tiles: int, selected: int) -> None:
        """Take the number of tiles of the run, and how many of them are to be brought up to date."""

    def line(self, text: str) -> None:
        """Take what the executor tells while it works: a decision, a wait, the address of a dashboard."""

    def tile(self, result: TileResult) -> None:
        """Take the result of a tile, also of one that was up to date."""

    def end(self, summary: Summary) -> None:
        """Take the state of the run after its last tile."""
