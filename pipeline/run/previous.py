"""The table of the execution before the last one, with which a report compares the run."""

from __future__ import annotations

from flexroad.catalog.storage.paths import Location, exists, read, write
from flexroad.pipeline.run.summary import read_summary
from flexroad.pipeline.store.tables import METRICS, PREVIOUS


def keep_previous(run: Location, flushed: bool = False) -> None:
    """Keep metrics.parquet as metrics.previous.parquet, if the last execution was complete.

    One that was interrupted or refused has left a table of some tiles: then the one before it stays.

    Raises
    ------
    OSError
        If it cannot be written.
    """
    last, table = read_summary(run), run / METRICS
    complete = last.get("pending") == 0 and not last.get("interrupted") and not last.get("refused")
    if complete and exists(table):
        write(run / PREVIOUS, read(table), flushed)
