"""Bring a run up to date: read the catalog, hold the run's lock, choose the executor, process, write the map.

::

    with created(path, catalog, config, selection, workers=workers) as prepared:     # or reopened(path)
        summary = process(prepared)
"""

from __future__ import annotations

import contextlib
import json
import shlex
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from flexroad.catalog import Bounds, Catalog, Tile
from flexroad.catalog.area import Area
from flexroad.catalog.errors import CatalogError
from flexroad.catalog.index import check_allowed
from flexroad.catalog.skipped import Skipped, lost
from flexroad.catalog.storage.outputs import made_folder
from flexroad.catalog.storage.paths import Location, exists
from flexroad.catalog.text import printable
from flexroad.pipeline.config.loading import compose
from flexroad.pipeline.config.models import Config
from flexroad.pipeline.config.settings import applied, parsed
from flexroad.pipeline.config.stages import STAGE_NAMES
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.execute import AdaptiveExecutor, DaskExecutor, Executor, SerialExecutor
from flexroad.pipeline.graph.borders import STAGE as BORDER
from flexroad.pipeline.graph.graph import layers_read
from flexroad.pipeline.run.collection import MAP, write_states
from flexroad.pipeline.run.events import Observer
from flexroad.pipeline.run.lock import run_lock
from flexroad.pipeline.run.record import Run, check_folder, check_links
from flexroad.pipeline.run.runner import run_tiles
from flexroad.pipeline.run.status import open_database, recorded, tile_files
from flexroad.pipeline.run.summary import Summary
from flexroad.pipeline.store.records import FAILED

EXECUTORS = ("auto", "serial", "dask")
SECTION = "cluster"


@dataclass(frozen=True)
class Workers:
    """Where tiles are processed."""

    executor: str = "auto"
    """auto: worker processes if they save time; serial: this process; dask: workers. Another value is the
    address of a running Dask scheduler, whose workers are used."""
    number: int | None = None
    """Most worker processes; None: as the configuration says."""
    dashboard: bool = False
    """Whether Dask's dashboard is served."""


@dataclass(frozen=True)
class Selection:
    """The tiles of a catalog that belong to a run; by default all."""

    tiles: Sequence[str] = ()
    bbox: Bounds | None = None
    area: Area | None = None

    def of(
        self, path: Location, catalog: Location, allow: Sequence[Any], config: Config
    ) -> tuple[Catalog, Catalog]:
        """Read a catalog and select tiles for the run at ``path``.

        - `run`: the tiles of the run, also tiles of earlier partial runs.
        - `selected`: the tiles to bring up to date.
        """
        whole = Catalog.read(catalog, allow)
        check_allowed(whole, layers_read(config))
        selected = whole.select(self.tiles, self.bbox, self.area)
        if not selected.tiles:
            raise ConfigError(f"catalog {catalog} has no tiles")
        some = self.tiles or self.bbox is not None or self.area
        taken, record = whole, path / "catalog.parquet"
        if some:
            # Earlier tiles of the run stay if they are in the catalog: their results stay in the tables.
            earlier = {tile.id for tile in Catalog.read(record).tiles} if exists(record) else set()
            ids = earlier | {tile.id for tile in selected.tiles}
            taken = replace(whole, tiles=tuple(tile for tile in whole.tiles if tile.id in ids))
        return replace(taken, skipped=_with_lost(path, whole)), selected


@dataclass(frozen=True)
class Prepared:
    """A run that this process may write until the end of the ``with`` block."""

    run: Run
    only: Callable[[Tile], bool]
    """Whether a tile is to be brought up to date."""
    executor: Executor
    observer: Observer
    force: frozenset[str] = field(default_factory=frozenset)
    """Stages to compute even if their results are in the store."""


@contextlib.contextmanager
def created(
    path: Location,
    catalog: Location,
    config: Config,
    selection: Selection,
    *,
    store: Location | None = None,
    checksum: bool = False,
    allow: Sequence[Any] = (),
    workers: Workers,
    observer: Observer | None = None,
) -> Iterator[Prepared]:
    """Hold a new or an existing run of a catalog while its tiles are brought up to date.

    - `path`: the run's folder: new, empty, or of a run, which is resumed.
    - `store`: folder of stage results that several runs share; by default a folder of the run.
    - `checksum`: whether changed sources are detected by their content, not by size and time.
    - `allow`: folders besides the catalog's that its files may lie below.
    """
    observer = observer or Observer()
    with observer.working(f"reading {catalog}"):
        tiles, selected = selection.of(path, catalog, allow, config)
    if note := tiles.same_places():
        observer.note(note)
    with _locked(path, observer, create=True) as died:
        with observer.working(f"preparing {path}"):
            run = Run.create(path, config, tiles, store, checksum)
        only = rerun_filter(run, [tile.id for tile in selected.tiles], failed=False)
        yield Prepared(run, only, _executor(run, workers, died, observer), observer)


@contextlib.contextmanager
def reopened(
    path: Location,
    tiles: Sequence[str] = (),
    *,
    failed: bool = False,
    from_stage: str | None = None,
    settings: Sequence[str] = (),
    allow: Sequence[Any] = (),
    workers: Workers,
    observer: Observer | None = None,
) -> Iterator[Prepared]:
    """Hold an existing run while its tiles are brought up to date.

    - `tiles`: ids of the tiles to process; none given: all, or the failed ones.
    - `from_stage`: stage that is computed again, with all later ones; ``export``: only the products are
      written again.
    - `settings`: options of the workers: ``cluster.memory=8 GiB``.
    - `allow`: folders besides the run's that its files may lie below.
    """
    observer = observer or Observer()
    with _locked(path, observer) as died:
        with observer.working(f"reading {path}"):
            run = with_workers(Run.open(path, allow), settings)
            check_allowed(run.catalog, layers_read(run.config))
        only = rerun_filter(run, tiles, failed)
        yield Prepared(run, only, _executor(run, workers, died, observer), observer, stages_from(from_stage))


def process(prepared: Prepared, verify: bool = False) -> Summary:
    """Bring the tiles of a run up to date, and write its tables, mosaics, collection and map.

    A tile that fails is counted, and does not stop the others.
    """
    run, observer = prepared.run, prepared.observer
    observer.start(len(run.catalog.tiles), sum(map(prepared.only, run.catalog.tiles)))
    try:
        summary = run_tiles(run, prepared.executor, prepared.only, prepared.force, observer.tile, verify)
    finally:
        try:
            write_states(run, run.path / MAP)
        except OSError as error:
            observer.warning(f"cannot write the map of the tiles: {error}")
    observer.end(summary)
    return summary


def stages_from(stage: str | None) -> frozenset[str]:
    """Return a stage and all later stages; empty without a stage."""
    steps = (*STAGE_NAMES, "export")
    force = frozenset(steps[steps.index(stage) :]) if stage else frozenset()
    # The control points of a border are part of the fit.
    return force | {BORDER} if "fit" in force else force


def rerun_filter(run: Run, tiles: Sequence[str], failed: bool) -> Callable[[Tile], bool]:
    """Return a filter for the tiles of a rerun: the given tiles, the failed tiles, both, or all.

    Tiles that were computed without an unusable file are taken as failed.
    """
    files_of = tile_files(run.path)
    ids = {tile.id for tile in run.catalog.select(tiles).tiles} if tiles else set()
    without_file = set[str]()
    if failed:
        with open_database(run) as database:
            records = (record for _, _, record in recorded(run, database) if record)
            without_file = {record.tile_id for record in records if record.left_out}

    def selected(tile: Tile) -> bool:
        if tile.id in ids or not (ids or failed):
            return True
        # A marker for earlier sources is enough: a corrected file is a reason to rerun.
        return tile.id in without_file or (failed and FAILED in files_of(tile.id))

    return selected


def _with_lost(path: Location, whole: Catalog) -> tuple[Skipped, ...]:
    """Return the skipped files of a catalog, with the tiles that the run at ``path`` loses by them.

    Tiles that an earlier execution lost stay lost until their file is no longer skipped.
    """
    record = path / "catalog.parquet"
    if not whole.skipped or not exists(record):
        return whole.skipped
    try:
        before = Catalog.read(record)
    except CatalogError:
        # A run whose catalog is damaged is repaired.
        return whole.skipped
    present = {tile.id for tile in whole.tiles}
    earlier = {file.path: [tile for tile in file.tiles if tile not in present] for file in before.skipped}
    return tuple(
        replace(file, tiles=tuple(dict.fromkeys([*file.tiles, *earlier.get(file.path, ())])))
        for file in lost(before.usable, present, whole.skipped)
    )


def with_workers(run: Run, settings: Sequence[str]) -> Run:
    """Return a run with options of its workers replaced for one command.

    Options of RUN/config.yaml that can start programs (`Cluster.programs`) are used only if they are sealed:
    the run may come from anyone.
    """
    changes = [parsed(text) for text in settings]
    for keys, _ in changes:
        if keys[0] != SECTION:
            raise ConfigError(
                f"--set {printable('.'.join(keys))}: rerun takes options of {SECTION} only, like "
                f"--set {SECTION}.workers=8; change others with `flexroad run`"
            )
    config = run.config
    if changes:
        config = compose(applied(config.raw, changes), config.name)
    given = {name for keys, _ in changes for name in keys[1:2]}
    whole = any(len(keys) == 1 for keys, _ in changes)
    unsealed = {name: value for name, value in config.cluster.programs.items() if name not in given}
    if unsealed and not whole and not run.programs_sealed:
        again = (f"--set {shlex.quote(f'{SECTION}.{n}={json.dumps(v)}')}" for n, v in unsealed.items())
        raise ConfigError(
            f"{run.path / 'config.yaml'}: {SECTION}.{next(iter(unsealed))} can start programs, and this user "
            f"has not given it on this machine; if it is right, add {' '.join(again)}"
        )
    return replace(run, config=config)


@contextlib.contextmanager
def _locked(path: Location, observer: Observer, create: bool = False) -> Iterator[bool]:
    """Hold the lock of a run folder; ``create`` makes a missing folder, and removes it if it stays empty.

    A folder with other files is then refused, before anything is written.

    Yields whether the process that held the lock before has died: a tile may have ended it.
    """
    taken_over: list[str] = []

    def notify(line: str) -> None:
        taken_over.append(line)
        observer.note(line)

    with contextlib.ExitStack() as stack:
        if create:
            check_folder(path)
            if isinstance(path, Path):
                try:
                    stack.enter_context(made_folder(path))
                except OSError as error:
                    raise ConfigError(
                        f"cannot write the run to {path}: {error}; choose another --out"
                    ) from error
        else:
            check_links(path)
        stack.enter_context(run_lock(path, notify))
        yield bool(taken_over)


def _executor(run: Run, workers: Workers, died: bool, observer: Observer) -> Executor:
    """Return the executor; ``died`` if the process that held the lock before has died."""
    if workers.executor == "serial":
        return SerialExecutor()
    cluster = run.config.cluster
    logs = run.path.resolve() / "logs" if isinstance(run.path, Path) else None
    scheduler = None if workers.executor in EXECUTORS else workers.executor
    parallel = DaskExecutor(workers.number, scheduler, cluster, workers.dashboard, observer.line, logs)
    if workers.executor != "auto" or died or workers.dashboard or cluster.needs_workers:
        return parallel
    return AdaptiveExecutor(workers.number or cluster.workers, parallel, observer.line)
