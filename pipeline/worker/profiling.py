"""Time, memory and bytes written by one stage of one tile."""

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
    """Start of the first computation, ISO 8601 in UTC; empty if nothing was computed."""
    seconds: float = 0.0
    """Computing time (s)."""
    bytes: int = 0
    """Bytes written to the store or as products."""
    peak_mb: float = 0.0
    """Peak memory of the process during the stage (MB)."""
    computed: int = 0
    """Number of nodes computed."""
    reused: int = 0
    """Number of nodes read from the store."""

    @contextlib.contextmanager
    def measure(self) -> Iterator[None]:
        """Add time and peak memory of the ``with`` block, also if it raises."""
        self.time = self.time or utc_now()
        _reset_peak()
        start = perf_counter()
        try:
            yield
        finally:
            self.seconds += perf_counter() - start
            self.peak_mb = max(self.peak_mb, peak_mb())


def utc_now() -> str:
    """Return the current time in UTC, ISO 8601 with milliseconds."""
    return datetime.now(UTC).isoformat(timespec="milliseconds")


def peak_mb() -> float:
    """Return the peak memory of this process (MB) since `_reset_peak`; outside Linux since its start."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def _reset_peak() -> None:
    # Only Linux can reset the peak.
    with contextlib.suppress(OSError):
        (PROC / "clear_refs").write_text("5")
