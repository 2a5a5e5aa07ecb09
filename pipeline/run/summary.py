"""The summary of a run: counts over all its tiles, also written to ``RUN/summary.json``."""

from __future__ import annotations

import contextlib
import importlib.metadata
from collections import Counter
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from itertools import islice
from typing import Any

from flexroad.catalog import Catalog
from flexroad.catalog.skipped import lines
from flexroad.catalog.storage.paths import Location, read, write
from flexroad.catalog.text import count
from flexroad.pipeline.store.database import Line
from flexroad.pipeline.store.records import Failure, TileState, dump_checked, load_checked

NAME = "summary.json"
MAX_FAILURES = 1000
"""Number of failures in a summary; the table of failures has all."""


@dataclass(frozen=True)
class Summary:
    """The state of a run and the result of its last execution."""

    tiles: int
    done: int
    """Tiles with a result, including results of earlier executions."""
    failed: int
    cached: int
    """Done tiles that were already done when the last execution started."""
    pending: int
    """Tiles without a result for the current files and options."""
    new: int = 0
    """Tiles without any result when the last execution started."""
    changed: int = 0
    """Tiles whose files or options had changed when the last execution started."""
    vanished: int = 0
    """Tiles with a result that were no longer in the catalog when the last execution started."""
    seconds: float = 0.0
    """Duration of the last execution (s)."""
    interrupted: bool = False
    """Whether the last execution was interrupted by the user."""
    refused: str = ""
    """Error that stopped the last execution as a whole; empty if there was none."""
    without_roads: int = 0
    """Done tiles without a road: their surface is the surface of the terrain."""
    flagged: tuple[str, ...] = ()
    """Ids of the done tiles to look at: tiles with flags except no-road in the variant exported first."""
    skipped: int = 0
    """Files that the catalog left out because they cannot be used."""
    lost: int = 0
    """Tiles of earlier executions that are not in the catalog because their file was skipped."""
    left_out: tuple[str, ...] = ()
    """The files that the catalog skipped, one line per reason, the first `MAX_FAILURES`."""
    failures: tuple[Failure, ...] = ()
    """The first `MAX_FAILURES` failures, in the catalog's order."""

    @property
    def to_look_at(self) -> str:
        """``; 4 to look at`` for the end of a line about the tiles; empty without flags."""
        return f"; {len(self.flagged)} to look at" if self.flagged else ""

    @property
    def files_skipped(self) -> str:
        """``; 2 files skipped by the catalog`` for the end of a line; empty without skipped files."""
        return f"; {count(self.skipped, 'file')} skipped by the catalog" if self.skipped else ""

    @property
    def exit_code(self) -> int:
        """Exit code of the command.

        0: all tiles are done; 1: not all, or the catalog skipped files; 2: refused; 130: interrupted.
        """
        if self.interrupted:
            return 130
        return 2 if self.refused else int(self.failed + self.pending + self.skipped > 0)


def summarise(catalog: Catalog, tiles: Iterable[Line], variant: str) -> Summary:
    """Return the summary of a run.

    - `tiles`: id, state and last record of its tiles; missing tiles are pending.
    """
    counts, without_roads = Counter[TileState](), 0
    flagged, failures = list[str](), list[Failure]()
    for tile_id, state, record in tiles:
        counts[state] += 1
        if record and state in ("done", "cached"):
            without_roads += record.without_roads
            flagged += [tile_id] if variant in record.flagged else []
        elif record and state == "failed" and len(failures) < MAX_FAILURES:
            failures += record.failures
    number, done = len(catalog.tiles), counts["done"] + counts["cached"]
    return Summary(
        number,
        done,
        counts["failed"],
        counts["cached"],
        number - done - counts["failed"],
        without_roads=without_roads,
        flagged=tuple(flagged),
        skipped=len(catalog.skipped),
        lost=len(catalog.lost),
        left_out=tuple(islice(lines(catalog.skipped), MAX_FAILURES)),
        failures=tuple(failures[:MAX_FAILURES]),
    )


def write_summary(run: Location, summary: Summary, flushed: bool = False, **about: Any) -> None:
    """Write summary.json: the fields of the summary and the fields in ``about``.

    With ``flushed`` its content is on the disk before it replaces the old one.
    """
    failures = [{key: value for key, value in asdict(f).items() if key != "trace"} for f in summary.failures]
    content = asdict(summary) | {
        "failures": failures,
        "exit_code": summary.exit_code,
        **about,
        "flexroad": importlib.metadata.version("flexroad"),
    }
    write(run / NAME, dump_checked(content), flushed)


def read_summary(run: Location) -> dict[str, Any]:
    """Return the content of summary.json, empty if it is missing or damaged."""
    with contextlib.suppress(OSError, ValueError):
        return load_checked(read(run / NAME))
    return {}
