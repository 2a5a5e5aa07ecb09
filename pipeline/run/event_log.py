"""What happened in a run, one event a line: ``RUN/log.jsonl``, or ``RUN/log/<start>.jsonl`` in a bucket.

::

    run    a run began: tiles, config, versions
    stage  a stage of a tile, at the time it began: seconds, bytes written, peak memory (MB), host, pid,
           nodes computed and reused
    tile   a tile was tried: status, seconds, notes, failures
    end    the run is over: how it stands, seconds
"""

from __future__ import annotations

import contextlib
import json
from dataclasses import asdict
from typing import IO, Any

from flexroad.catalog.storage.paths import Location, is_remote
from flexroad.catalog.storage.staging import StagedFile
from flexroad.pipeline.worker.profiling import now
from flexroad.pipeline.worker.tile import TileResult


class EventLog:
    """Appends events; use it as a context. A disk too full for the log is no reason to stop the tiles."""

    def __init__(self, run: Location) -> None:
        start = now().replace(":", "").replace("+0000", "Z")
        self._staged = StagedFile(run / "log" / f"{start}.jsonl" if is_remote(run) else run / "log.jsonl")
        self._file: IO[str] | None = None

    def __enter__(self) -> EventLog:
        with contextlib.suppress(OSError):
            self._file = self._staged.path.open("a", buffering=1)
        return self

    def __exit__(self, *_: object) -> None:
        with contextlib.suppress(OSError):
            if self._file:
                self._file.close()
            self._staged.put()
        self._staged.close()

    def note(self, event: str, time: str = "", **what: Any) -> None:
        """Append one event, of now unless ``time`` says when."""
        line = {"time": time or now(), "event": event, **what}
        with contextlib.suppress(OSError):
            if self._file:
                self._file.write(json.dumps(line) + "\n")
            self._staged.sync_if_due()

    def tile(self, result: TileResult) -> None:
        """Append one event for every stage of a tile, and one for the tile."""
        where: dict[str, Any] = {"host": result.host, "pid": result.pid}
        for stage, span in result.spans.items():
            cost = {
                "seconds": round(span.seconds, 4),
                "bytes": span.bytes,
                "peak_mb": round(span.peak_mb, 1),
                "computed": span.computed,
                "reused": span.reused,
            }
            self.note("stage", span.time, tile=result.tile_id, stage=stage, **cost, **where)
        told = {"status": result.status, "seconds": round(result.entry.seconds, 4)} | where
        if result.notes:
            told["notes"] = list(result.notes)
        if result.failures:
            told["failures"] = [asdict(failure) for failure in result.failures]
        self.note("tile", tile=result.tile_id, **told)
