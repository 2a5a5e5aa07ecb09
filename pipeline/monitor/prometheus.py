"""A run's state as a text file for Prometheus, by the textfile collector of its node exporter."""

from __future__ import annotations

import contextlib
import threading
import time
from collections import Counter
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from prometheus_client import CollectorRegistry

    from flexroad.pipeline.run.summary import Summary
    from flexroad.pipeline.worker.tile import TileResult

EVERY_S = 10.0
STATES = ("done", "cached", "failed", "pending")


class Textfile:
    """Told of every tile and of the end; writes the file whole, every ten seconds and at the end.

    Parameters
    ----------
    path : Path
        The file, which should end in ``.prom``; one for each run.
    run : str
        What the label ``run`` says.
    """

    def __init__(self, path: Path, run: str, every_s: float = EVERY_S) -> None:
        self.path = path
        self.run = run
        self.every_s = every_s
        self.start = time.time()
        self.total = 0
        self.states: Counter[str] = Counter()
        self.seconds: Counter[str] = Counter()
        self.peak_mb = 0.0
        self.end: tuple[float, int] | None = None
        self._guard = threading.Lock()
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._keep_writing, name="prometheus", daemon=True)

    def __enter__(self) -> Textfile:
        self.write()
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._over.set()
        self._thread.join()
        with contextlib.suppress(OSError):
            self.write()

    def __call__(self, result: TileResult) -> None:
        """Take note of a tile."""
        with self._guard:
            self.states[result.status] += 1
            self.seconds.update(result.seconds)
            self.peak_mb = max(self.peak_mb, *(span.peak_mb for span in result.spans.values()), 0.0)

    def ended(self, exit_code: int, how: Summary | None) -> None:
        """Take note of the end, and of how the run stands then, over all its tiles."""
        self.end = (time.time(), exit_code)
        if how is not None:
            self.total = how.tiles
            self.states = Counter(done=how.done - how.cached, cached=how.cached, failed=how.failed)

    def write(self) -> None:
        """Write the file.

        Raises
        ------
        OSError
            If the folder is not there or cannot be written.
        """
        from prometheus_client import write_to_textfile

        with self._guard:
            found = self._registry()
        write_to_textfile(str(self.path), found)

    def _keep_writing(self) -> None:
        while not self._over.wait(self.every_s):
            # A disk full for a while is no reason to stop.
            with contextlib.suppress(OSError):
                self.write()

    def _registry(self) -> CollectorRegistry:
        from prometheus_client import CollectorRegistry, Gauge

        found = CollectorRegistry()

        def gauge(name: str, meaning: str, value: float, **labels: str) -> None:
            made = found_gauges.get(name) or Gauge(
                f"flexroad_{name}", meaning, ["run", *labels], registry=found
            )
            found_gauges[name] = made
            made.labels(self.run, *labels.values()).set(value)

        found_gauges: dict[str, Gauge] = {}
        pending = max(0, self.total - sum(self.states.values()))
        for state, count in {**dict.fromkeys(STATES, 0), **self.states, "pending": pending}.items():
            gauge("tiles", "Tiles by state; done and cached are apart.", count, state=state)
        for stage, seconds in self.seconds.items():
            gauge("stage_seconds", "Time spent computing in this run, by stage.", seconds, stage=stage)
        gauge("worker_peak_bytes", "Greatest memory of a worker process.", self.peak_mb * 2**20)
        gauge("run_start_time_seconds", "When the run began.", self.start)
        gauge("run_running", "1 while the run goes on.", self.end is None)
        if self.end is not None:
            gauge("run_end_time_seconds", "When the run ended.", self.end[0])
            gauge("run_exit_code", "0 done, 1 some failed, 2 could not start, 130 interrupted.", self.end[1])
        return found
