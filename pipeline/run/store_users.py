"""Which runs use a shared store: a small file of each in ``STORE/runs``, so that `clean` knows them all."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator

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
    """Write down that a run uses its store; of a store in its own folder it goes without saying.

    Raises
    ------
    OSError
        If the store cannot be written.
    """
    if absolute(store) != absolute(run / "store"):
        path = _entry(store, run)
        if not exists(path):
            write(path, json.dumps({"run": str(absolute(run))}).encode())


def runs_using(store: Location) -> Iterator[Location]:
    """Yield the folders of the runs that use a store, as far as they were written down.

    Raises
    ------
    OSError, ValueError, KeyError
        If an entry cannot be read.
    """
    # A store in a run's folder is that run's.
    if exists(store.parent / "run.json"):
        yield absolute(store.parent)
    for name in sorted(listing(store / FOLDER)):
        if name.endswith(".json") and not name.startswith("."):
            yield parse_location(json.loads(read(store / FOLDER / name))["run"])


def unregister(store: Location, run: Location) -> bool:
    """Take a run from those that use a store; tell whether it was among them."""
    path = _entry(store, run)
    known = exists(path)
    remove(path)
    return known


def _entry(store: Location, run: Location) -> Location:
    name = hashlib.sha256(str(absolute(run)).encode()).hexdigest()[:16]
    return store / FOLDER / f"{name}.json"
