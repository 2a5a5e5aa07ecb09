"""How a run stands, over all its tiles: for people, and as ``RUN/summary.json`` for programs."""

from __future__ import annotations

import contextlib
import importlib.metadata
import json
from collections import Counter
from dataclasses import asdict, dataclass, replace
from itertools import islice
from typing import TYPE_CHECKING, Any

from flexroad.catalog.storage.paths import Place, read, write
from flexroad.pipeline.entry import Failure
from flexroad.pipeline.ledger import NAME as LEDGER
from flexroad.pipeline.ledger import Ledger

if TYPE_CHECKING:
    from flexroad.pipeline.run import Run

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


def summarise(tiles: int, ledger: Ledger) -> Summary:
    """Return how the tiles stand by the ledger, without another look at them."""
    counts = ledger.counts()
    done = counts["done"] + counts["cached"]
    failures = tuple(islice(ledger.failures(), MOST_TOLD))
    left = tiles - done - counts["failed"]
    return Summary(tiles, done, counts["failed"], counts["cached"], left, failures=failures)


def summary(run: Run) -> Summary:
    """Return how a run stands now: every tile, its sources and its products are looked at."""
    from flexroad.pipeline.look import stands

    counts: Counter[str] = Counter()
    failures: list[Failure] = []
    with Ledger.peek(run.path / LEDGER) as ledger:
        for now in stands(run, ledger):
            counts["done"] += now.done
            counts["failed"] += now.failed
            counts["cached"] += now.done and ledger.standing(now.graph.tile.id) == "cached"
            if now.failed and now.known and len(failures) < MOST_TOLD:
                failures += now.known.failures
    tiles = len(run.catalog.tiles)
    left = tiles - counts["done"] - counts["failed"]
    found = Summary(tiles, counts["done"], counts["failed"], counts["cached"], left, failures=tuple(failures))
    last = read_summary(run.path)
    known = ("new", "changed", "vanished", "seconds", "interrupted", "refused")
    return replace(found, **{name: last[name] for name in known if name in last})


def write_summary(run: Run, how: Summary, start: str, end: str) -> None:
    """Write summary.json.

    Raises
    ------
    OSError
        If it cannot be written.
    """
    failures = [{key: value for key, value in asdict(f).items() if key != "trace"} for f in how.failures]
    told = asdict(how) | {
        "failures": failures,
        "exit_code": how.exit_code,
        "start": start,
        "end": end,
        "config": run.config.name,
        "origin": list(run.origin),
        "flexroad": importlib.metadata.version("flexroad"),
    }
    write(run.path / NAME, json.dumps(told, indent=1).encode())


def read_summary(run: Place) -> dict[str, Any]:
    """Return what summary.json holds; nothing if there is no sound one."""
    with contextlib.suppress(OSError, ValueError):
        found = json.loads(read(run / NAME))
        return found if isinstance(found, dict) else {}
    return {}
