"""A run: the folder with its configuration, catalog and results.

::

    RUN/config.yaml      the configuration, resolved
    RUN/catalog.parquet  the tiles of the run
    RUN/run.json         store, origin, versions
    RUN/tiles/           products and markers
    RUN/store/           artefacts, unless the store is shared
    RUN/metrics.parquet  one row per (tile, variant); metrics.previous.parquet: before the last execution
    RUN/failures.csv     one row per failure
    RUN/levels.csv       one row per tile, variant and level, if tiles have decks or tunnels
    RUN/log.jsonl        one event per line
    RUN/collection.json  STAC collection of the done tiles
    RUN/*.vrt            their rasters as mosaics; RUN/*.qml: their styles for QGIS
"""

from __future__ import annotations

import hashlib
import importlib.metadata
import json
import platform
import shlex
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import yaml

from flexroad.catalog import Catalog, Tile
from flexroad.catalog.guard.source_files import source_stat
from flexroad.catalog.index import needed
from flexroad.catalog.storage.buckets import StatCache
from flexroad.catalog.storage.paths import (
    Location,
    absolute,
    check_writable,
    contained,
    entries,
    exists,
    flush_names,
    links_out,
    listing,
    parse_location,
    read,
    remove,
    stat,
    visible_entry,
    write,
)
from flexroad.catalog.trust import AllowedFolders
from flexroad.pipeline.config.loading import compose, read_mapping
from flexroad.pipeline.config.models import Config
from flexroad.pipeline.config.stages import STAGE_NAMES, model_files
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.graph.borders import check_tiles
from flexroad.pipeline.graph.graph import Pattern, TileGraph
from flexroad.pipeline.graph.layers import check_layers
from flexroad.pipeline.graph.sources import Recorded, Stat
from flexroad.pipeline.run.events import LOG
from flexroad.pipeline.run.lock import NAME as LOCK
from flexroad.pipeline.run.seal import seal, sealed
from flexroad.pipeline.run.summary import read_summary
from flexroad.pipeline.store.products import TileProducts
from flexroad.pipeline.store.records import DONE, FAILED, dump_checked, load_checked
from flexroad.pipeline.worker.tile import TileJob

PACKAGES = ("flexroad", "numpy", "scipy", "numba", "rasterio", "startinpy", "dask", "torch")
STORE = "store"
RECORD = "run.json"
"""The first file of a run: a folder with this file is a run, even if it is not complete."""

USERS = "runs"
"""Folder of a shared store with a small file for each run that uses it, read by `flexroad clean`."""


@dataclass(frozen=True)
class Run:
    """An opened run folder."""

    path: Location
    config: Config
    catalog: Catalog
    store: Location
    origin: tuple[float, float]
    """Origin (easting, northing) of mesh translations, whole metres; fixed when the run is made."""
    checksum: bool
    """Whether fingerprints hash the bytes of source files instead of their size and time."""
    versions: dict[str, str]
    """Versions of Python and of the packages in `PACKAGES`."""
    allowed: tuple[str, ...] = ()
    """Folders and addresses that sources may be read from, as sealed when the run was made."""
    exported: tuple[str, ...] = ()
    """Variants exported by this or an earlier configuration of the run."""
    collection: str = ""
    """Id of the run's STAC collection: the name of its folder when it was made."""
    programs_sealed: bool = True
    """Whether this user has given its options that can start programs (`Cluster.programs`)."""

    @classmethod
    def create(
        cls,
        path: Location,
        config: Config,
        catalog: Catalog,
        store: Location | None = None,
        checksum: bool = False,
    ) -> Run:
        """Create a run folder, or update an existing one with a new configuration or catalog.

        The run may read the folders that the catalog may read (`Catalog.read`). If the program itself has
        just made the catalog, these are the folders of its files.
        """
        run = cls.planned(path, config, catalog, store, checksum)
        try:
            for folder in (path, run.store):
                check_writable(folder)
            run._write()
            register(run.store, path)
        except OSError as error:
            raise ConfigError(
                f"cannot write the run to {path}: {error}; choose another --out or --store"
            ) from error
        return run

    @classmethod
    def planned(
        cls,
        path: Location,
        config: Config,
        catalog: Catalog,
        store: Location | None = None,
        checksum: bool = False,
    ) -> Run:
        """Return the run that `create` would make or update; nothing is written."""
        check_folder(path)
        if not catalog.usable:
            raise ConfigError(f"no tile can be used: {catalog.tiles[0].fault}")
        check_inputs(config, catalog)
        old = _record(path)
        # Existing meshes are relative to the earlier origin, which is also in the last summary.
        origin = (old or read_summary(path)).get("origin")
        if not origin:
            origin = [min(axis) for axis in zip(*(tile.grid.origin for tile in catalog.usable), strict=True)]
        store = store or _store(old, path, "add --store")
        exported = _exported(old, config)
        origin = (origin[0], origin[1])
        folders, collection = folders_of(catalog), _collection(old, path)
        return cls(path, config, catalog, store, origin, checksum, versions(), folders, exported, collection)

    @classmethod
    def open(cls, path: Location | str, allow: Sequence[str | Path] = ()) -> Run:
        """Open an existing run with its current configuration and catalog.

        - `allow`: further folders and addresses below which sources and the store may lie. The run's folder
          and the folders given when the run was made are always allowed (`flexroad.pipeline.run.seal`).
        """
        path = parse_location(path)
        check_links(path)
        record = _record(path)
        if record is None:
            raise ConfigError(
                f"{path} is no run: run.json is missing or damaged; make one with `flexroad run --out {path}`"
            )
        store = _store(record, path, "begin with flexroad --allow", allow)
        config = _config(path / "config.yaml").model_copy(update={"name": record["config"]})
        listed = record.get("allowed", [])
        allowed = tuple(listed) if sealed(listed, record.get("seal")) else ()
        catalog = Catalog.read(path / "catalog.parquet", (*allowed, *allow))
        origin = (record["origin"][0], record["origin"][1])
        return cls(
            path,
            config,
            catalog,
            store,
            origin,
            record["checksum"],
            record["versions"],
            allowed,
            _exported(record, config),
            _collection(record, path),
            sealed(config.cluster.programs, record.get("programs_seal")),
        )

    @cached_property
    def pattern(self) -> Pattern:
        """The part of the graph that is the same for all tiles."""
        return Pattern.of(self.config)

    def graph(self, tile: Tile, stat_file: Stat = source_stat, recorded: Recorded = ()) -> TileGraph:
        """Return the graph of a tile for the current configuration and sources (`Pattern.graph`)."""
        return self.pattern.graph(tile, self.checksum, stat_file, recorded)

    def stat_cache(self) -> Stat:
        """Return a stat function for many source files; in a bucket it lists each folder once."""
        remote = StatCache()
        return lambda file: source_stat(file) if isinstance(file, Path) else remote(file)

    def job(self, graph: TileGraph, force: frozenset[str] = frozenset()) -> TileJob:
        """Return the job that a worker needs to process one tile."""
        run, store = str(absolute(self.path)), str(absolute(self.store))
        return TileJob(graph, run, store, self.origin, self.collection, force, self.config.cluster.flush)

    def folder(self, tile_id: str) -> TileProducts:
        """Return the folder of a tile's products."""
        return TileProducts.of(self.path, tile_id)

    def _write(self) -> None:
        if not exists(self.path / RECORD):
            # This empty record marks the folder as a run if the creation is interrupted (`check_folder`).
            write(self.path / RECORD, dump_checked({}), flushed=True)
            flush_names(self.path)
        config = yaml.safe_dump(self.config.raw, sort_keys=False).encode()
        write(self.path / "config.yaml", config, flushed=True)
        self.catalog.write(self.path / "catalog.parquet", movable=False)
        record = {
            "config": self.config.name,
            "store": str(absolute(self.store)),
            "shared_store": absolute(self.store) != absolute(self.path / "store"),
            "origin": list(self.origin),
            "checksum": self.checksum,
            "versions": self.versions,
            "allowed": list(self.allowed),
            "seal": seal(self.allowed),
            "store_seal": seal({"store": str(absolute(self.store))}),
            "programs_seal": seal(self.config.cluster.programs),
            "exported": list(self.exported),
            "collection": self.collection,
        }
        write(self.path / RECORD, dump_checked(record), flushed=True)
        # The run's folder may be new.
        flush_names(self.path, self.path.parent)


def check_links(path: Location, below: bool = False) -> None:
    """Check that no file or folder of a run is a link that leads out of the run.

    A run may come from anyone. Through such a link, files outside the run would be read, written or deleted.
    Tiles and artefacts are checked when they are used (`contained`).

    - `path`: the run's folder, or a folder in it; the path itself may be a link.
    - `below`: whether folders inside it are searched, too.
    """
    try:
        link = next(links_out(path, below), None)
    except OSError as error:
        raise ConfigError(f"cannot read {path}: {error.strerror or error}; correct that") from error
    if link is not None:
        remedy = f"move the files to {link}"
        if link.name == STORE:
            remedy += f", or give their folder with --store {link.resolve()}, without the link"
        raise ConfigError(f"{link} is a link that leads out of {path}, to {link.resolve()}; {remedy}")


def check_folder(path: Location) -> None:
    """Check that a run may be written to a folder, so that no existing files are replaced."""
    check_own(path, lambda: exists(path / RECORD) or _has_results(path), "a run", "--out", {LOCK, LOG})
    check_links(path)


def check_own(
    folder: Location, is_own: Callable[[], bool], kind: str, option: str, ignored: Collection[str] = ()
) -> None:
    """Check that a folder has no visible files, or was written by an earlier command (`is_own`).

    - `kind`: the kind of output, for the message: ``a run``.
    """
    try:
        other = visible_entry(folder, ignored)
        refused = other is not None and not is_own()
    except OSError as error:
        reason = f"{error.strerror or error}; correct that or choose another {option}"
        raise ConfigError(f"cannot read {folder}: {reason}") from error
    if refused:
        raise ConfigError(
            f"{folder} has files that are not of {kind}, such as {other}; "
            f"choose an empty or new folder with {option}"
        )


def _has_results(path: Location) -> bool:
    """Return whether a folder has results of a run, which can be resumed without its run.json."""
    if read_summary(path) or any(exists(path / "store" / stage) for stage in STAGE_NAMES):
        return True
    return any(name.endswith((f"/{DONE}", f"/{FAILED}")) for name, _ in entries(path / "tiles"))


def check_inputs(config: Config, catalog: Catalog) -> None:
    """Check, without reading the tiles' files, that a run of a catalog can give results."""
    check_models(config)
    check_layers(config, catalog)
    check_tiles(config, catalog)


def check_models(config: Config) -> None:
    """Check that all models named by a configuration exist."""
    for chain in config.chains.values():
        for stage, options in chain.items():
            for path in model_files(options):
                if path.is_file():
                    continue
                values = options.model_dump()
                remedy = "restore it, or name another one"
                if path == values.get("model"):
                    remedy = f"make it with `flexroad train CATALOG --labels mask -o {path}`"
                raise ConfigError(f"{config.name}: {stage}: {path} does not exist; {remedy}")


def folders_of(catalog: Catalog) -> tuple[str, ...]:
    """Return the folders that the tiles of a catalog may read."""
    given = {tile.allowed for tile in catalog.tiles if tile.allowed}
    made = Catalog(tuple(tile for tile in catalog.tiles if tile.allowed is None))
    roots = [
        folder
        for root in sorted({tile.root for tile in made.tiles})
        for folder in (root, *needed(made, AllowedFolders.of(root)))
    ]
    return tuple(dict.fromkeys([*(folder for allowed in given for folder in allowed.folders), *roots]))


def versions() -> dict[str, str]:
    """Return the versions of Python and of the packages in `PACKAGES`, by name."""
    by_name = {"python": platform.python_version()}
    for package in PACKAGES:
        try:
            by_name[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            by_name[package] = "not installed"
    return by_name


def _store(record: dict[str, Any] | None, run: Location, remedy: str, allow: Sequence[Any] = ()) -> Location:
    """Return the store of a run; a store outside its folder must be sealed or allowed (`remedy`)."""
    if record is None or not record["shared_store"]:
        return run / "store"
    named = str(record["store"])
    permitted = AllowedFolders.of(run, allow).permits(f"{named}/{RECORD}")
    if not permitted and not sealed({"store": named}, record.get("store_seal")):
        raise ConfigError(
            f"{run} has its store in {named}, which this user has not given on this machine; if it is right, "
            f"{remedy} {shlex.quote(named)}"
        )
    return parse_location(named)


def _exported(record: dict[str, Any] | None, config: Config) -> tuple[str, ...]:
    earlier = (record or {}).get("exported", ())
    return tuple(dict.fromkeys([*earlier, *config.export.variants]))


def _collection(record: dict[str, Any] | None, path: Location) -> str:
    return (record or {}).get("collection") or absolute(path).name or "run"


def _config(path: Location) -> Config:
    file = stat(path)
    if file is not None and not file.size:
        # An empty file would be valid: a configuration with all defaults.
        raise ConfigError(f"{path} is empty, as after a power failure; `flexroad run` writes it again")
    if file is None:
        fault = "is not a regular file" if exists(path) else "is no configuration: it is missing"
        raise ConfigError(f"{path} {fault}; `flexroad run` writes it again")
    return compose(read_mapping(read(path), str(path)), str(path))


def _record(run: Location) -> dict[str, Any] | None:
    """Return the content of run.json, None if it is missing or damaged."""
    try:
        record = load_checked(read(run / RECORD))
    except (FileNotFoundError, NotADirectoryError, ValueError):
        return None
    except OSError as error:
        # After an access or connection error it is unknown whether a run exists.
        raise ConfigError(f"cannot read {run / RECORD}: {error.strerror or error}") from error
    required = {"config", "store", "shared_store", "origin", "checksum", "versions"}
    return record if required <= record.keys() else None


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
    for name in sorted(listing(contained(store / USERS, store))):
        if name.endswith(".json") and not name.startswith("."):
            yield parse_location(json.loads(read(store / USERS / name))["run"])


def unregister(store: Location, run: Location) -> None:
    """Remove a run from the runs of a store."""
    remove(_entry(store, run))


def _entry(store: Location, run: Location) -> Location:
    name = hashlib.sha256(str(absolute(run)).encode()).hexdigest()[:16]
    return contained(store / USERS / f"{name}.json", store)
