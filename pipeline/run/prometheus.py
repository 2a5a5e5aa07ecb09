"""State of a run as a text file for the textfile collector of the Prometheus node exporter."""

from __future__ import annotations

import contextlib
import threading
import time
from collections import Counter
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any

from flexroad.catalog.lazy import lazy
from flexroad.catalog.storage.outputs import atomic_path

if TYPE_CHECKING:
    from flexroad.pipeline.run.summary import Summary
    from flexroad.pipeline.worker.tile import TileResult

prometheus_client = lazy("prometheus_client")

EVERY_S = 10.0
"""Interval between writes (s)."""
STATES = ("done", "cached", "failed", "pending")


class Textfile:
    """Writes the metrics of a run to a file, atomically, every ten seconds and at the end.

    It is called with each tile result; `ended` adds the exit code.

    Parameters
    ----------
    path : Path
        The file; its name should end in ``.prom``. Each run needs its own.
    run : str
        Value of the label ``run``.
    every_s : float
        Interval between writes (s).
    """

    def __init__(self, path: Path, run: str, every_s: float = EVERY_S) -> None:
        self.path = path
        self.run = run
        self.every_s = every_s
        self.start = time.time()
        self.total = 0
        self.states: Counter[str] = Counter()
        self.without_roads = 0
        self.seconds: Counter[str] = Counter()
        self.peak_mb = 0.0
        self.end: tuple[float, int] | None = None
        self._lock = threading.Lock()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._keep_writing, name="prometheus", daemon=True)

    def __enter__(self) -> Textfile:
        self.write()
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stop.set()
        self._thread.join()
        with contextlib.suppress(OSError):
            self.write()

    def __call__(self, result: TileResult) -> None:
        """Add a tile's result."""
        with self._lock:
            self.states[result.status] += 1
            self.without_roads += result.entry.without_roads
            self.seconds.update(result.seconds)
            self.peak_mb = max(self.peak_mb, *(span.peak_mb for span in result.spans.values()), 0.0)

    def ended(self, exit_code: int, summary: Summary | None) -> None:
        """Set the end of the run, its exit code and the states of all its tiles."""
        self.end = (time.time(), exit_code)
        if summary is not None:
            self.total = summary.tiles
            done = summary.done - summary.cached
            self.states = Counter(done=done, cached=summary.cached, failed=summary.failed)
            self.without_roads = summary.without_roads

    def write(self) -> None:
        """Write the file.

        Raises
        ------
        OSError
            If the folder does not exist or is not writable.
        """
        with self._lock:
            text = prometheus_client.generate_latest(self._registry())
        # The library's own function would replace a device or a pipe by a file.
        with atomic_path(self.path) as temporary:
            temporary.write_bytes(text)

    def _keep_writing(self) -> None:
        while not self._stop.wait(self.every_s):
            # The disk may be full for a while: try again at the next interval.
            with contextlib.suppress(OSError):
                self.write()

    def _registry(self) -> Any:
        registry = prometheus_client.CollectorRegistry()
        gauges: dict[str, Any] = {}

        def gauge(name: str, meaning: str, value: float, **labels: str) -> None:
            if name not in gauges:
                gauges[name] = prometheus_client.Gauge(
                    f"flexroad_{name}", meaning, ["run", *labels], registry=registry
                )
            gauges[name].labels(self.run, *labels.values()).set(value)

        pending = max(0, self.total - sum(self.states.values()))
        for state, count in {**dict.fromkeys(STATES, 0), **self.states, "pending": pending}.items():
            gauge("tiles", "Tiles by state; done does not include cached.", count, state=state)
        gauge("tiles_without_roads", "Done and cached tiles that have no road.", self.without_roads)
        for stage, seconds in self.seconds.items():
            gauge("stage_seconds", "Time spent computing in this run, by stage.", seconds, stage=stage)
        gauge("worker_peak_bytes", "Peak memory of a worker process.", self.peak_mb * 2**20)
        gauge("run_start_time_seconds", "Start of the run.", self.start)
        gauge("run_running", "1 while the run is in progress.", self.end is None)
        if self.end is not None:
            gauge("run_end_time_seconds", "End of the run.", self.end[0])
            gauge("run_exit_code", "0 done, 1 some failed, 2 could not start, 130 interrupted.", self.end[1])
        return registry
