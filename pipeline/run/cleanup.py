"""``flexroad clean``: find and delete files that are no longer needed; files of other programs are kept.

Needed files are: artefacts in the current graph of any run of the store; tiles in the run's catalog, or lost
with a skipped file; products in the tiles' items or in the export options.
"""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Literal

from flexroad.catalog.errors import CatalogError
from flexroad.catalog.ids import safe_name
from flexroad.catalog.storage.paths import Location, absolute, entries, exists, hidden_files, listing, remove
from flexroad.catalog.text import Notify
from flexroad.pipeline.config.stages import STAGE_NAMES
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.graph.borders import STAGE as BORDER
from flexroad.pipeline.run.lock import run_lock
from flexroad.pipeline.run.record import RECORD, USERS, Run, check_links, check_models, runs_using
from flexroad.pipeline.run.status import known_record, open_database, peek_statuses
from flexroad.pipeline.store.records import DONE, FAILED
from flexroad.pipeline.worker.exports import KINDS, LEVEL_KINDS

Kind = Literal["artefacts", "products", "tiles", "temporary files"]
MEANING: dict[Kind, str] = {
    "artefacts": "artefacts that no run needs",
    "products": "products that are no longer exported",
    "tiles": "files of tiles that the catalog no longer has",
    "temporary files": "temporary files of writers that were killed",
}
TEMPORARY = re.compile(r"\..+\.[0-9a-f]{32}\.tmp|\.probe-[0-9a-f]{32}")
ARTEFACT = re.compile(r"([0-9a-f]{32})\.npz")


@dataclass(frozen=True)
class Garbage:
    """A file that is no longer needed; ``size`` in bytes."""

    kind: Kind
    path: Location
    size: int


@contextlib.contextmanager
def exclusive(
    run: Run, without: Sequence[Location], notify: Notify, allow: Sequence[str] = ()
) -> Iterator[list[Run]]:
    """Lock all other runs of this run's store; a context manager that gives all runs, this one first.

    - `run`: the run; the caller holds its lock.
    - `without`: runs to ignore because they no longer exist.
    """
    with contextlib.ExitStack() as stack:
        runs = [run]
        for path in _others(run, without):
            remedy = f"restore it, or `flexroad clean {run.path} --forget {path}` if it no longer exists"
            if not exists(path / RECORD):
                raise ConfigError(f"{path} uses the store {run.store}, but is missing; {remedy}")
            check_links(path)
            stack.enter_context(run_lock(path, notify))
            try:
                runs.append(Run.open(path, allow))
            except (CatalogError, ConfigError) as error:
                raise ConfigError(
                    f"{path} uses the store {run.store}, but cannot be read ({error}); {remedy}"
                ) from error
        yield [user for user in runs if _same(user.store, run.store)]


def find_garbage(runs: Sequence[Run]) -> Iterator[Garbage]:
    """Yield the unneeded files of a store and of the first run's folder; ``runs``: all runs of the store."""
    first = runs[0]
    # Files are listed before the needed files are known: files that other commands write meanwhile stay.
    unneeded = {name for name, _ in _in_store(first.store)}
    unneeded -= _needed(runs)
    yield from (garbage for name, garbage in _in_store(first.store) if name in unneeded)
    yield from _in_tiles(first)
    yield from _temporary(first.path, hidden_files(first.path))


def delete(garbage: Iterable[Garbage]) -> Iterator[Garbage]:
    """Delete the files and the folders that become empty; yield each file after it was deleted."""
    for file in garbage:
        remove(file.path)
        yield file
        if isinstance(file.path, Path) and file.kind != "temporary files":
            # A folder that still has files of other programs is kept: rmdir fails.
            with contextlib.suppress(OSError):
                file.path.parent.rmdir()


def _others(run: Run, without: Sequence[Location]) -> list[Location]:
    """Return the other runs of the store."""
    try:
        users = set(runs_using(run.store))
    except (OSError, ValueError, KeyError) as error:
        raise ConfigError(
            f"the list of runs in {run.store / USERS} cannot be read: {error!r}; correct or remove that file"
        ) from error
    others = (path for path in users if not any(_same(path, excluded) for excluded in (run.path, *without)))
    return sorted(others, key=str)


def _same(first: Location, second: Location) -> bool:
    return str(absolute(first)) == str(absolute(second))


def _needed(runs: Iterable[Run]) -> set[bytes]:
    """Return the fingerprints of all artefacts that the runs may reuse."""
    needed: set[bytes] = set()
    for run in runs:
        check_models(run.config)
        for status in peek_statuses(run, run.catalog.tiles):
            needed |= {bytes.fromhex(name) for name, node in status.graph.nodes.items() if node.stored}
    return needed


def _in_store(store: Location) -> Iterator[tuple[bytes, Garbage]]:
    """Yield the artefacts and temporary files of a store, each with its fingerprint or its name."""
    for stage in (*STAGE_NAMES, BORDER):
        for folder, files in _folders(store / stage):
            yield from _named(_temporary(folder, files))
            for name, size in files.items():
                artefact = ARTEFACT.fullmatch(name)
                if artefact and name[:2] == folder.name:
                    yield bytes.fromhex(artefact[1]), Garbage("artefacts", folder / name, size)
    yield from _named(_temporary(store, hidden_files(store)))


def _named(files: Iterable[Garbage]) -> Iterator[tuple[bytes, Garbage]]:
    return ((file.path.name.encode(), file) for file in files)


def _in_tiles(run: Run) -> Iterator[Garbage]:
    tiles = {safe_name(tile.id): tile for tile in run.catalog.tiles}
    lost = set(map(safe_name, run.catalog.lost))
    current = _ends(run.config.export.variants, run.config.export.formats)
    ever = _ends(run.exported, KINDS) | current
    ever |= {f"_{variant}{kind.suffix}" for variant in run.exported for kind in LEVEL_KINDS}
    with open_database(run) as database:
        for folder, files in _folders(run.path / "tiles"):
            yield from _temporary(folder, files)
            products = [folder.name + end for end in sorted(ever) if folder.name + end in files]
            tile = tiles.get(folder.name)
            if folder.name in lost:
                # The tile keeps its last results until its file is repaired.
                continue
            if tile is None:
                # Markers come last, so that an interrupted deletion is continued by the next clean.
                markers = [name for name in (DONE, FAILED) if name in files]
                yield from (Garbage("tiles", folder / name, files[name]) for name in [*products, *markers])
            elif entry := known_record(run, database, tile.id):
                kept = {folder.name + end for end in current} | entry.sizes.keys()
                yield from (
                    Garbage("products", folder / name, files[name]) for name in products if name not in kept
                )


def _ends(variants: Iterable[str], formats: Iterable[str]) -> set[str]:
    """Return the ends of product file names, after the tile's name."""
    return {f"_{variant}{kind.suffix}" for variant in variants for name in formats for kind in KINDS[name]}


def _temporary(folder: Location, files: dict[str, int]) -> Iterator[Garbage]:
    for name, size in files.items():
        if TEMPORARY.fullmatch(name):
            yield Garbage("temporary files", folder / name, size)


def _folders(parent: Location) -> Iterator[tuple[Location, dict[str, int]]]:
    """Yield the folders directly below ``parent`` with the sizes of their files (bytes) by name.

    Links are not followed: they may lead to files that do not belong to the run.
    """
    if isinstance(parent, Path):
        for path in sorted(parent.iterdir()) if parent.is_dir() and not parent.is_symlink() else []:
            if path.is_dir() and not path.is_symlink():
                yield path, {file: stat.size for file, stat in listing(path).items()}
        return
    parts = ((name.partition("/"), file.size) for name, file in entries(parent))
    # The listing has the files of a folder one after the other.
    for folder, files in groupby(parts, key=lambda part: part[0][0]):
        below = {name: size for (_, slash, name), size in files if slash}
        if below:
            yield parent / folder, below
