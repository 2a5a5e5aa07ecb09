"""What a stage costs on one tile: time, memory, bytes written."""

from __future__ import annotations

import contextlib
import resource
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from time import perf_counter

PROC = Path("/proc/self")


@dataclass
class StageCost:
    """The cost of one stage over all variants of a tile."""

    time: str = ""
    """When it was first begun, as ISO 8601 in UTC; empty if it never was."""
    seconds: float = 0.0
    bytes: int = 0
    """Written to the store or among the products."""
    peak_mb: float = 0.0
    """Most memory the process held meanwhile, all it holds anyway included."""
    computed: int = 0
    """How many of its nodes were computed."""
    reused: int = 0
    """How many were read from the store."""

    @contextlib.contextmanager
    def measured(self) -> Iterator[None]:
        """Add what happens inside, whether it ends well or not."""
        self.time = self.time or now()
        _forget_peak()
        start = perf_counter()
        try:
            yield
        finally:
            self.seconds += perf_counter() - start
            self.peak_mb = max(self.peak_mb, peak_mb())


def now() -> str:
    """Return the time as ISO 8601 in UTC."""
    return datetime.now(UTC).isoformat(timespec="milliseconds")


def peak_mb() -> float:
    """Return the most memory this process held (MB) since `_forget_peak`, or ever where that is unknown."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def _forget_peak() -> None:
    # Linux alone can; elsewhere a stage's peak is that of the process so far.
    with contextlib.suppress(OSError):
        (PROC / "clear_refs").write_text("5")
