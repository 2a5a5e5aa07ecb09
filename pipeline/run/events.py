"""The events of a run: for displays (`Observer`), and in its log (`EventLog`), a JSON line each.

The log is ``RUN/log.jsonl``, in a bucket ``RUN/log/<start>.jsonl``. ::

    run    start of a run: tiles, config, versions
    stage  one stage of a tile, with its start time: seconds, bytes written, peak memory (MB), host, pid,
           nodes computed and reused
    tile   a processed tile: status, seconds, notes, failures
    work   whether the tiles run on worker processes, and why
    end    end of the run: its summary, seconds
"""

from __future__ import annotations

import contextlib
import json
import os
from contextlib import AbstractContextManager
from dataclasses import asdict
from pathlib import Path
from typing import IO, Any

from flexroad.catalog.storage.buckets import StagedFile
from flexroad.catalog.storage.outputs import output_file
from flexroad.catalog.storage.paths import Location, is_remote
from flexroad.pipeline.run.summary import Summary
from flexroad.pipeline.store.records import utc_now
from flexroad.pipeline.worker.tile import TileResult

LOG = "log.jsonl"


class EventLog:
    """Appends events to the log; a context manager. Write errors (full disk) are ignored and stop no run."""

    def __init__(self, run: Location) -> None:
        start = utc_now().replace(":", "").replace("+0000", "Z")
        self._staged = StagedFile(run / "log" / f"{start}.jsonl" if is_remote(run) else run / LOG)
        self._file: IO[str] | None = None

    def __enter__(self) -> EventLog:
        with contextlib.suppress(OSError):
            # Opening a pipe without a reader would block the run.
            self._file = output_file(self._staged.path).open("a", buffering=1)
            if _is_cut_off(self._staged.path):
                self._file.write("\n")
        return self

    def __exit__(self, *_: object) -> None:
        with contextlib.suppress(OSError):
            if self._file:
                self._file.close()
            self._staged.put()
        self._staged.close()

    def note(self, event: str, time: str = "", **fields: Any) -> None:
        """Append one event; ``time`` is its time (ISO 8601, UTC), by default the current time."""
        line = {"time": time or utc_now(), "event": event, **fields}
        with contextlib.suppress(OSError):
            if self._file:
                self._file.write(json.dumps(line) + "\n")
            self._staged.sync_if_due()

    def tile(self, result: TileResult) -> None:
        """Append one event for each stage of a tile and one for the tile."""
        process: dict[str, Any] = {"host": result.host, "pid": result.pid}
        for stage, span in result.spans.items():
            cost = {
                "seconds": round(span.seconds, 4),
                "bytes": span.bytes,
                "peak_mb": round(span.peak_mb, 1),
                "computed": span.computed,
                "reused": span.reused,
            }
            self.note("stage", span.time, tile=result.tile_id, stage=stage, **cost, **process)
        fields = {"status": result.status, "seconds": round(result.entry.seconds, 4)} | process
        if result.notes:
            fields["notes"] = list(result.notes)
        if result.failures:
            fields["failures"] = [asdict(failure) for failure in result.failures]
        self.note("tile", tile=result.tile_id, **fields)


def _is_cut_off(path: Path) -> bool:
    """Return whether the last line of a file has no end, as after a full disk or a killed process."""
    with path.open("rb") as file:
        size = file.seek(0, os.SEEK_END)
        file.seek(max(size - 1, 0))
        return file.read() not in (b"", b"\n")


class Observer:
    """Takes the events of a run in their order; each method does nothing unless a subclass overrides it."""

    def working(self, work: str) -> AbstractContextManager[None]:
        """Enclose long work before the first tile: ``reading survey.parquet``."""
        return contextlib.nullcontext()

    def note(self, text: str) -> None:
        """Take a remark in one line."""

    def warning(self, text: str) -> None:
        """Take a warning in one line: a problem that does not stop the run."""

    def start(self, tiles: int, selected: int) -> None:
        """Take the number of tiles of the run, and how many of them are to be brought up to date."""

    def line(self, text: str) -> None:
        """Take a message of the executor: a decision, a wait, the address of a dashboard."""

    def tile(self, result: TileResult) -> None:
        """Take the result of a tile, also of one that was up to date."""

    def end(self, summary: Summary) -> None:
        """Take the state of the run after its last tile."""
