"""How a run stands, over all its tiles: for people, and as ``RUN/summary.json`` for programs."""

from __future__ import annotations

import contextlib
import importlib.metadata
import json
from dataclasses import asdict, dataclass
from itertools import islice
from typing import Any

from flexroad.catalog.storage.paths import Location, read, write
from flexroad.pipeline.store.database import RunDatabase
from flexroad.pipeline.store.records import Failure

NAME = "summary.json"
MOST_TOLD = 1000
"""Failures told of; the table of failures has all."""


@dataclass(frozen=True)
class Summary:
    """How a run stands, and what its last execution did."""

    tiles: int
    done: int
    """Tiles with results, those of earlier runs included."""
    failed: int
    cached: int
    """Of those done, how many the last run found done already."""
    pending: int
    """Tiles without a result of the files and options as they are."""
    new: int = 0
    """Tiles that had no result before the last run."""
    changed: int = 0
    """Tiles whose result was of other files or options when the last run began."""
    vanished: int = 0
    """Tiles with results that the catalog no longer had when the last run began."""
    seconds: float = 0.0
    """How long the last run took."""
    interrupted: bool = False
    refused: str = ""
    """Why the last run did not go on, where that was not for single tiles to tell."""
    failures: tuple[Failure, ...] = ()
    """The first of them, in the catalog's order."""

    @property
    def exit_code(self) -> int:
        """What the command ends with: 0 if all is done, 1 if not, 2 if refused, 130 after an interruption."""
        if self.interrupted:
            return 130
        return 2 if self.refused else int(self.failed + self.pending > 0)


def summarise(tiles: int, database: RunDatabase) -> Summary:
    """Return how the tiles stand by the database, without another look at them."""
    counts = database.counts()
    done = counts["done"] + counts["cached"]
    failures = tuple(islice(database.failures(), MOST_TOLD))
    left = tiles - done - counts["failed"]
    return Summary(tiles, done, counts["failed"], counts["cached"], left, failures=failures)


def write_summary(run: Location, how: Summary, **about: Any) -> None:
    """Write summary.json: the figures, and what is given about the run beside them.

    Raises
    ------
    OSError
        If it cannot be written.
    """
    failures = [{key: value for key, value in asdict(f).items() if key != "trace"} for f in how.failures]
    told = asdict(how) | {
        "failures": failures,
        "exit_code": how.exit_code,
        **about,
        "flexroad": importlib.metadata.version("flexroad"),
    }
    write(run / NAME, json.dumps(told, indent=1).encode())


def read_summary(run: Location) -> dict[str, Any]:
    """Return what summary.json holds; nothing if there is no sound one."""
    with contextlib.suppress(OSError, ValueError):
        found = json.loads(read(run / NAME))
        return found if isinstance(found, dict) else {}
    return {}
