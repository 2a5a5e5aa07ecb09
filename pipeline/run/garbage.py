"""``flexroad clean``: find what nobody needs any more, and drop it; whatever is not known for ours stays.

What is needed: of artefacts, all that the graphs of all runs of the store name, as their options and sources
are now; of tiles, those in the run's catalog; of products, those of the tiles' items and of the export.
"""

from __future__ import annotations

import contextlib
import re
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from flexroad.catalog.errors import CatalogError
from flexroad.catalog.storage.paths import Location, absolute, exists, listing, remove
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.graph.stages import STAGE_NAMES
from flexroad.pipeline.run.lock import run_lock
from flexroad.pipeline.run.record import Run, check_models
from flexroad.pipeline.run.status import tile_statuses
from flexroad.pipeline.run.store_users import FOLDER, runs_using
from flexroad.pipeline.store.database import NAME as DATABASE
from flexroad.pipeline.store.database import RunDatabase
from flexroad.pipeline.store.products import safe_name
from flexroad.pipeline.store.records import DONE, FAILED
from flexroad.pipeline.worker.exports import SUFFIXES

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
    """A file that nobody needs."""

    kind: Kind
    path: Location
    size: int


@contextlib.contextmanager
def exclusive(run: Run, without: Sequence[Location], say: Callable[[str], None]) -> Iterator[list[Run]]:
    """Keep every other run of this run's store from working meanwhile; give them all, this one first.

    Parameters
    ----------
    without : sequence of Place
        Runs that are no more.
    say : callable
        Told of locks of dead holders.

    Raises
    ------
    ConfigError
        If one of them is at work, or cannot be read: what it needs is not known then.
    """
    with contextlib.ExitStack() as stack:
        runs = [run]
        for path in _others(run, without):
            remedy = f"bring it back, or `flexroad clean {run.path} --forget {path}` if it is no more"
            if not exists(path / "run.json"):
                raise ConfigError(f"{path} uses the store {run.store}, but is not there; {remedy}")
            stack.enter_context(run_lock(path, say))
            try:
                runs.append(Run.open(path))
            except (CatalogError, ConfigError) as error:
                raise ConfigError(
                    f"{path} uses the store {run.store}, but cannot be read ({error}); {remedy}"
                ) from error
        yield [one for one in runs if _same(one.store, run.store)]


def find_garbage(runs: Sequence[Run]) -> Iterator[Garbage]:
    """Yield what nobody needs in the store of these runs, and in the folder of the first one.

    Parameters
    ----------
    runs : sequence of Run
        All that use the store.

    Raises
    ------
    ConfigError
        If a model of theirs is missing: without it, it is not known what they need.
    """
    first = runs[0]
    needed = _needed(runs)
    yield from _in_store(first.store, needed)
    yield from _in_tiles(first)
    for folder in (first.path, first.store):
        # A bucket knows no temporary names.
        if isinstance(folder, Path):
            files = [path for path in folder.glob(".*") if path.is_file()]
            yield from _temporary(folder, {path.name: path.stat().st_size for path in files})


def delete(found: Iterable[Garbage]) -> Iterator[Garbage]:
    """Remove the files, and folders that are empty then; yield each when it is gone."""
    for one in found:
        remove(one.path)
        yield one
        if isinstance(one.path, Path) and one.kind != "temporary files":
            # Others' files stay, and so do their folders.
            with contextlib.suppress(OSError):
                one.path.parent.rmdir()


def _others(run: Run, without: Sequence[Location]) -> list[Location]:
    """Return the other runs of the store."""
    try:
        found = set(runs_using(run.store))
    except (OSError, ValueError, KeyError) as error:
        raise ConfigError(
            f"the list of runs in {run.store / FOLDER} cannot be read: {error!r}; mend or remove that file"
        ) from error
    left = (path for path in found if not any(_same(path, one) for one in (run.path, *without)))
    return sorted(left, key=str)


def _same(one: Location, other: Location) -> bool:
    return str(absolute(one)) == str(absolute(other))


def _needed(runs: Iterable[Run]) -> set[bytes]:
    """Return the fingerprints of all artefacts that runs may take up."""
    needed: set[bytes] = set()
    for run in runs:
        check_models(run.config)
        with RunDatabase.peek(run.path / DATABASE) as database:
            for now in tile_statuses(run, database):
                needed |= {bytes.fromhex(name) for name, node in now.graph.nodes.items() if node.stored}
    return needed


def _in_store(store: Location, needed: set[bytes]) -> Iterator[Garbage]:
    for stage in STAGE_NAMES:
        for folder, files in _folders(store / stage):
            yield from _temporary(folder, files)
            for name, size in files.items():
                artefact = ARTEFACT.fullmatch(name)
                if artefact and name[:2] == folder.name and bytes.fromhex(artefact[1]) not in needed:
                    yield Garbage("artefacts", folder / name, size)


def _in_tiles(run: Run) -> Iterator[Garbage]:
    known = {safe_name(tile.id): tile for tile in run.catalog.tiles}
    ends = _ends(run.config.export.variants, run.config.export.formats)
    ours = _ends(run.exported, SUFFIXES) | ends
    with RunDatabase.peek(run.path / DATABASE) as database:
        for folder, files in _folders(run.path / "tiles"):
            yield from _temporary(folder, files)
            made = [folder.name + end for end in sorted(ours) if folder.name + end in files]
            tile = known.get(folder.name)
            if tile is None:
                # The markers last: a tile half dropped is found again.
                markers = [name for name in (DONE, FAILED) if name in files]
                yield from (Garbage("tiles", folder / name, files[name]) for name in [*made, *markers])
            elif entry := database.get(tile.id):
                kept = {folder.name + end for end in ends} | entry.sizes.keys()
                yield from (
                    Garbage("products", folder / name, files[name]) for name in made if name not in kept
                )


def _ends(variants: Iterable[str], formats: Iterable[str]) -> set[str]:
    """Return what names of products end with, after the tile's."""
    return {f"_{variant}{end}" for variant in variants for kind in formats for end in SUFFIXES[kind]}


def _temporary(folder: Location, files: dict[str, int]) -> Iterator[Garbage]:
    for name, size in files.items():
        if TEMPORARY.fullmatch(name):
            yield Garbage("temporary files", folder / name, size)


def _folders(above: Location) -> Iterator[tuple[Location, dict[str, int]]]:
    """Yield the folders directly below one, with the sizes of their files; folder by folder on disk."""
    if isinstance(above, Path):
        names = sorted(path.name for path in above.iterdir() if path.is_dir()) if above.is_dir() else []
        for name in names:
            yield above / name, {file: seen.size for file, seen in listing(above / name).items()}
        return
    found: defaultdict[str, dict[str, int]] = defaultdict(dict)
    for path, seen in listing(above).items():
        folder, slash, file = path.partition("/")
        if slash:
            found[folder][file] = seen.size
    yield from ((above / name, files) for name, files in found.items())
