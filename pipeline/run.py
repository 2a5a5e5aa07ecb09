"""A run: a folder that remembers what was asked, and the loop that brings its tiles up to date.

::

    RUN/config.yaml      the configuration, resolved
    RUN/catalog.parquet  the tiles asked for
    RUN/run.json         store, origin, versions
    RUN/tiles/           products and markers
    RUN/store/           artefacts, unless the store is shared
    RUN/metrics.parquet  one row per (tile, variant)
    RUN/failures.csv     one row per failure
    RUN/log.jsonl        one event per line
"""

from __future__ import annotations

import contextlib
import importlib.metadata
import json
import platform
import time
from array import array
from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import yaml

from flexroad.catalog import Catalog, Tile
from flexroad.catalog.storage.paths import (
    Place,
    Sightings,
    absolute,
    exists,
    is_remote,
    place,
    read,
    stat,
    write,
)
from flexroad.pipeline.config import Config, compose, load_config
from flexroad.pipeline.entry import FAILED, Failure
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.execute import Executor
from flexroad.pipeline.graph import Look, Pattern, Recorded, TileGraph, any_gone, model_files
from flexroad.pipeline.journal import Journal
from flexroad.pipeline.ledger import NAME as LEDGER
from flexroad.pipeline.ledger import Ledger, Standing
from flexroad.pipeline.look import Folders, stands
from flexroad.pipeline.meter import now
from flexroad.pipeline.registry import register
from flexroad.pipeline.store import TileFolder, check_writable
from flexroad.pipeline.summary import Summary, read_summary, summarise, write_summary
from flexroad.pipeline.tables import write_tables
from flexroad.pipeline.warm import warm
from flexroad.pipeline.work import Job, TileResult, do_tile, failed_row, give_up

PACKAGES = ("flexroad", "numpy", "scipy", "numba", "rasterio", "startinpy", "dask", "torch")


@dataclass(frozen=True)
class Run:
    """An opened run folder."""

    path: Place
    config: Config
    catalog: Catalog
    store: Place
    origin: tuple[float, float]
    """Whole-metre (easting, northing) all meshes are placed against; fixed when the run is made."""
    checksum: bool
    versions: dict[str, str]
    allowed: tuple[str, ...] = ()
    """Folders and addresses outside the catalog's own that sources may lie in."""
    exported: tuple[str, ...] = ()
    """Variants whose products the run has, or had when its configuration was another."""

    @classmethod
    def create(
        cls,
        path: Place,
        config: Config,
        catalog: Catalog,
        store: Place | None = None,
        checksum: bool = False,
        allowed: Sequence[str] = (),
    ) -> Run:
        """Make a run folder, or bring an old one up to date with a new configuration or catalog.

        Raises
        ------
        ConfigError
            If the folder or the store cannot be written, or a model is missing.
        """
        check_models(config)
        old = _record(path)
        # Meshes of before are placed against it: the last summary has it, too.
        origin = (old or read_summary(path)).get("origin") or _origin(catalog)
        store = store or (place(old["store"]) if old and old["shared_store"] else path / "store")
        exported = _exported(old, config)
        place_of = (origin[0], origin[1])
        run = cls(path, config, catalog, store, place_of, checksum, versions(), tuple(allowed), exported)
        try:
            for folder in (path, store):
                check_writable(folder)
            run._write()
            register(run)
        except OSError as error:
            raise ConfigError(
                f"cannot write the run to {path}: {error}; choose another --out or --store"
            ) from error
        return run

    @classmethod
    def open(cls, path: Place | str) -> Run:
        """Open a run made before, with its configuration and catalog as they are now.

        Raises
        ------
        ConfigError
            If the folder is no run, or its configuration was edited into something invalid.
        CatalogError
            If its catalog is damaged.
        """
        path = place(path)
        found = _record(path)
        if found is None:
            raise ConfigError(
                f"{path} is no run: it has no sound run.json; make one with `flexroad run --out {path}`"
            )
        store = place(found["store"]) if found["shared_store"] else path / "store"
        config = _config(path / "config.yaml").model_copy(update={"name": found["config"]})
        catalog = Catalog.read(path / "catalog.parquet")
        origin = (found["origin"][0], found["origin"][1])
        return cls(
            path,
            config,
            catalog,
            store,
            origin,
            found["checksum"],
            found["versions"],
            tuple(found.get("allowed", ())),
            _exported(found, config),
        )

    @cached_property
    def pattern(self) -> Pattern:
        """What the graphs of all tiles have in common."""
        return Pattern.of(self.config)

    def graph(self, tile: Tile, look: Look = stat, recorded: Recorded = ()) -> TileGraph:
        """Return the graph of a tile, as configuration and sources are now (`Pattern.graph`)."""
        return self.pattern.graph(tile, self.checksum, look, recorded)

    def sightings(self) -> Look:
        """Return what looks at many sources: those of a bucket by a list of each folder, once."""
        many = Sightings()
        # On disk a look costs next to nothing, and late is better than early.
        return lambda file: many(file) if is_remote(file) else stat(file)

    def job(self, graph: TileGraph, anew: frozenset[str] = frozenset()) -> Job:
        """Return what a worker needs to do one tile."""
        return Job(graph, str(absolute(self.path)), str(absolute(self.store)), self.origin, anew)

    def folder(self, tile_id: str) -> TileFolder:
        """Return where a tile's products are."""
        return TileFolder.of(self.path, tile_id)

    def _write(self) -> None:
        write(self.path / "config.yaml", yaml.safe_dump(self.config.raw, sort_keys=False).encode())
        self.catalog.write(self.path / "catalog.parquet", movable=False)
        found = {
            "config": self.config.name,
            "store": str(absolute(self.store)),
            "shared_store": absolute(self.store) != absolute(self.path / "store"),
            "origin": list(self.origin),
            "checksum": self.checksum,
            "versions": self.versions,
            "allowed": list(self.allowed),
            "exported": list(self.exported),
        }
        write(self.path / "run.json", json.dumps(found, indent=1).encode())


@dataclass(frozen=True)
class Stock:
    """What a run has to do, and what became of its tiles since the last one."""

    todo: array[int]
    """Where in the catalog the tiles to do are."""
    new: int
    changed: int
    vanished: int


def execute(
    run: Run,
    executor: Executor,
    only: Callable[[Tile], bool] = lambda tile: True,
    anew: frozenset[str] = frozenset(),
    watch: Callable[[TileResult], None] = lambda result: None,
    verify: bool = False,
) -> Summary:
    """Bring the run's tiles up to date, write the tables, then summary.json.

    Parameters
    ----------
    only : callable
        Which tiles; the tables are over all of them.
    anew : frozenset of str
        Stages to compute even if the store has them.
    watch : callable
        Told of every result as it comes, those found done included.
    verify : bool
        Read all products, and do again the tiles whose are not what was written.

    Raises
    ------
    ConfigError
        If a model is missing, or each of several tiles lacks a file.
    OSError
        If the ledger or the tables cannot be written, as on a full disk.
    """
    check_models(run.config)
    with Ledger.open(run.path / LEDGER) as ledger, Journal(run.path) as journal:
        journal.note("run", tiles=len(run.catalog.tiles), config=run.config.name, versions=run.versions)
        close = partial(_close, run, ledger, journal, now(), time.perf_counter())
        stock = None
        try:
            stock = take_stock(run, ledger, only, anew, watch, verify)
            with contextlib.closing(_results(run, executor, ledger, _jobs(run, stock, anew))) as results:
                for result in results:
                    ledger.record(result.entry)
                    journal.tile(result)
                    watch(result)
        except BaseException as error:
            # What is done is in the tables.
            close(stock, error)
            raise
        return close(stock)


def take_stock(
    run: Run,
    ledger: Ledger,
    only: Callable[[Tile], bool],
    anew: frozenset[str],
    watch: Callable[[TileResult], None],
    verify: bool,
) -> Stock:
    """Look at every tile once, bring the ledger up to date, and tell what there is to do.

    Raises
    ------
    ConfigError
        If each of several tiles lacks a file.
    """
    todo, standings, new, changed, gone = array("L"), list[Standing](), 0, 0, 0
    for position, found in enumerate(stands(run, ledger)):
        gone += any_gone(found.graph)
        wanted = only(found.graph.tile)
        if wanted and verify and found.done and not run.folder(found.graph.tile.id).verified():
            found = replace(found, current=False)
        new += found.known is None
        changed += found.known is not None and not found.current
        standing: Standing = "done" if found.done else "failed" if found.failed else "pending"
        if found.known and found.unknown:
            ledger.record(found.known)
        if found.known and wanted and found.done and found.fresh and not anew:
            standing = "cached"
            watch(TileResult(found.known, "cached"))
        elif wanted:
            todo.append(position)
        standings.append(standing)
    if gone == len(run.catalog.tiles) > 1:
        # Not to be told by each tile, whose results would be lost by it.
        raise ConfigError(_nothing_there(run, found.graph))
    ledger.flush()
    names = (tile.id for tile in run.catalog.tiles)
    vanished = ledger.ask(zip(names, standings, strict=True))
    return Stock(todo, new, changed, vanished)


def _nothing_there(run: Run, graph: TileGraph) -> str:
    path = next(path for path, seen in graph.seen.items() if seen is None)
    return (
        f"each of the {len(run.catalog.tiles)} tiles lacks a file, as tile {graph.tile.id} does {path}; "
        "is the disk with the survey mounted?"
    )


def _jobs(run: Run, stock: Stock, anew: frozenset[str]) -> Iterator[Job]:
    if stock.todo:
        warm(run.config)
    look = run.sightings()
    for position in stock.todo:
        # Made a second time: thousands kept since the stocktaking would fill the memory, and be old by now.
        yield run.job(run.graph(run.catalog.tiles[position], look), anew)


def _results(
    run: Run, executor: Executor, ledger: Ledger, jobs: Iterator[Job]
) -> Generator[TileResult, None, None]:
    """Yield what tiles come to; at the end record those that got done although nobody heard of it."""
    flying: dict[str, Tile] = {}

    def noted() -> Iterator[Job]:
        for job in jobs:
            flying[job.graph.tile.id] = job.graph.tile
            yield job

    found = executor.map(do_tile, noted(), _lost, partial(check_writable, run.store))
    try:
        for result in found:
            flying.pop(result.tile_id)
            yield result
    finally:
        # Interrupted: first nobody works any more, then what lies there counts.
        found.close()
        for stand in stands(run, ledger, flying.values()):
            if stand.known and stand.unknown:
                ledger.record(stand.known)


def _close(
    run: Run,
    ledger: Ledger,
    journal: Journal,
    start: str,
    began: float,
    stock: Stock | None,
    error: BaseException | None = None,
) -> Summary:
    """Write the tables and the summary, as far as the run came."""
    refused = str(error) if isinstance(error, ConfigError) else ""
    interrupted = isinstance(error, KeyboardInterrupt)
    how = replace(summarise(len(run.catalog.tiles), ledger), interrupted=interrupted, refused=refused)
    if stock:
        how = replace(how, new=stock.new, changed=stock.changed, vanished=stock.vanished)
        write_tables(run.path, ledger.rows(), ledger.failures())
    how = replace(how, seconds=round(time.perf_counter() - began, 3))
    journal.note("end", **{name: value for name, value in asdict(how).items() if name != "failures"})
    write_summary(run, how, start, now())
    return how


def check_models(config: Config) -> None:
    """Refuse a configuration that names a model which is not there, before any tile is tried.

    Raises
    ------
    ConfigError
        If a file that options name is missing; the line says how to get one.
    """
    for chain in config.chains.values():
        for stage, options in chain.items():
            for path in model_files(options):
                if path.is_file():
                    continue
                chosen = options.model_dump()
                remedy = "restore it, or name another one"
                if path == chosen.get("model"):
                    how = f"--method {chosen['method']} --labels mask -o {path}"
                    remedy = f"make it with `flexroad train CATALOG {how}`"
                raise ConfigError(f"{config.name}: {stage}: {path} does not exist; {remedy}")


def select(run: Run, tiles: Sequence[str], failed: bool) -> Callable[[Tile], bool]:
    """Return which tiles a rerun means: those named, those failed, both, or all.

    Raises
    ------
    CatalogError
        If a tile is not in the run's catalog.
    """
    folders = Folders(run.path)
    named = {tile.id for tile in run.catalog.select(tiles).tiles} if tiles else set()

    def chosen(tile: Tile) -> bool:
        if tile.id in named or not (named or failed):
            return True
        # Whatever it failed of: a file mended since is why it is tried again.
        return failed and FAILED in folders(tile.id)

    return chosen


def asked(path: Place, whole: Catalog, wanted: Catalog) -> Catalog:
    """Return the tiles a run is about when some tiles of a catalog are asked for.

    Those, and those it was asked for before that the catalog still has: their results stay in the tables.
    """
    record = path / "catalog.parquet"
    before = {tile.id for tile in Catalog.read(record).tiles} if exists(record) else set()
    known = before | {tile.id for tile in wanted.tiles}
    return Catalog(tuple(tile for tile in whole.tiles if tile.id in known))


def versions() -> dict[str, str]:
    """Return the versions of what computes, for the record."""
    found = {"python": platform.python_version()}
    for package in PACKAGES:
        try:
            found[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            found[package] = "not installed"
    return found


def _lost(job: Job, why: str) -> TileResult:
    """Make the failed result of a tile whose worker died."""
    graph = job.graph
    failure = Failure(graph.tile.id, "worker", "WorkerDied", why)
    rows = [failed_row(graph, variant, failure.line) for variant in graph.variants]
    return TileResult(give_up(job, rows, [failure]), "failed")


def _origin(catalog: Catalog) -> tuple[float, float]:
    corners = [tile.grid.origin for tile in catalog.tiles]
    return min(east for east, _ in corners), min(north for _, north in corners)


def _exported(record: dict[str, Any] | None, config: Config) -> tuple[str, ...]:
    before = (record or {}).get("exported", ())
    return tuple(dict.fromkeys([*before, *config.export.variants]))


def _config(where: Place) -> Config:
    seen = stat(where)
    if seen is not None and not seen.size:
        # It would be read as one that changes no default.
        raise ConfigError(f"{where} is empty, as a power failure leaves it; `flexroad run` writes it anew")
    if isinstance(where, Path):
        return load_config(where)
    return compose(yaml.safe_load(read(where)), str(where))


def _record(run: Place) -> dict[str, Any] | None:
    """Return what run.json holds, or None if it is not there or damaged."""
    try:
        found: dict[str, Any] = json.loads(read(run / "run.json"))
    except (FileNotFoundError, NotADirectoryError, ValueError):
        return None
    except OSError as error:
        # Storage that refuses or does not answer is no proof that there is no run.
        raise ConfigError(f"cannot read {run / 'run.json'}: {error.strerror or error}") from error
    known = {"config", "store", "shared_store", "origin", "checksum", "versions"}
    return found if isinstance(found, dict) and known <= found.keys() else None
