"""The runs that use a shared store: one small file for each in ``STORE/runs``, read by `flexroad clean`."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator

from flexroad.catalog.storage.links import contained
from flexroad.catalog.storage.paths import (
    Location,
    absolute,
    exists,
    listing,
    parse_location,
    read,
    remove,
    write,
)

FOLDER = "runs"


def register(store: Location, run: Location) -> None:
    """Register a run with its store; not needed for a store in the run's own folder."""
    if absolute(store) != absolute(run / "store"):
        path = _entry(store, run)
        if not exists(path):
            write(path, json.dumps({"run": str(absolute(run))}).encode(), flushed=True)


def runs_using(store: Location) -> Iterator[Location]:
    """Yield the folders of the runs registered with a store."""
    # A store in a run's folder belongs to that run.
    if exists(store.parent / "run.json"):
        yield absolute(store.parent)
    for name in sorted(listing(contained(store / FOLDER, store))):
        if name.endswith(".json") and not name.startswith("."):
            yield parse_location(json.loads(read(store / FOLDER / name))["run"])


def unregister(store: Location, run: Location) -> None:
    """Remove a run from the runs of a store."""
    remove(_entry(store, run))


def _entry(store: Location, run: Location) -> Location:
    name = hashlib.sha256(str(absolute(run)).encode()).hexdigest()[:16]
    return contained(store / FOLDER / f"{name}.json", store)
