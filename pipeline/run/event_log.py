"""The event log of a run, one JSON line per event: ``RUN/log.jsonl``, in a bucket ``RUN/log/<start>.jsonl``.

::

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
from dataclasses import asdict
from pathlib import Path
from typing import IO, Any

from flexroad.catalog.storage.buckets import StagedFile
from flexroad.catalog.storage.outputs import output_file
from flexroad.catalog.storage.paths import Location, is_remote
from flexroad.pipeline.store.records import utc_now
from flexroad.pipeline.worker.tile import TileResult

NAME = "log.jsonl"


class EventLog:
    """Appends events to the log; a context manager. Write errors (full disk) are ignored and stop no run."""

    def __init__(self, run: Location) -> None:
        start = utc_now().replace(":", "").replace("+0000", "Z")
        self._staged = StagedFile(run / "log" / f"{start}.jsonl" if is_remote(run) else run / NAME)
        self._file: IO[str] | None = None

    def __enter__(self) -> EventLog:
        with contextlib.suppress(OSError):
            # A pipe without a reader would block the run.
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
