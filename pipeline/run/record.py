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

import importlib.metadata
import json
import platform
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import yaml

from flexroad.catalog import Catalog, Tile
from flexroad.catalog.storage.paths import (
    Location,
    StatCache,
    absolute,
    is_remote,
    parse_location,
    read,
    stat,
    write,
)
from flexroad.pipeline.config.loading import compose, load_config
from flexroad.pipeline.config.models import Config
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.graph.graph import Pattern, Recorded, Stat, TileGraph
from flexroad.pipeline.graph.stages import model_files
from flexroad.pipeline.run.store_users import register
from flexroad.pipeline.run.summary import read_summary
from flexroad.pipeline.store.artefacts import check_writable
from flexroad.pipeline.store.products import TileProducts
from flexroad.pipeline.worker.tile import TileJob

PACKAGES = ("flexroad", "numpy", "scipy", "numba", "rasterio", "startinpy", "dask", "torch")


@dataclass(frozen=True)
class Run:
    """An opened run folder."""

    path: Location
    config: Config
    catalog: Catalog
    store: Location
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
        path: Location,
        config: Config,
        catalog: Catalog,
        store: Location | None = None,
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
        store = store or (parse_location(old["store"]) if old and old["shared_store"] else path / "store")
        exported = _exported(old, config)
        place_of = (origin[0], origin[1])
        run = cls(path, config, catalog, store, place_of, checksum, versions(), tuple(allowed), exported)
        try:
            for folder in (path, store):
                check_writable(folder)
            run._write()
            register(store, path)
        except OSError as error:
            raise ConfigError(
                f"cannot write the run to {path}: {error}; choose another --out or --store"
            ) from error
        return run

    @classmethod
    def open(cls, path: Location | str) -> Run:
        """Open a run made before, with its configuration and catalog as they are now.

        Raises
        ------
        ConfigError
            If the folder is no run, or its configuration was edited into something invalid.
        CatalogError
            If its catalog is damaged.
        """
        path = parse_location(path)
        found = _record(path)
        if found is None:
            raise ConfigError(
                f"{path} is no run: it has no sound run.json; make one with `flexroad run --out {path}`"
            )
        store = parse_location(found["store"]) if found["shared_store"] else path / "store"
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

    def graph(self, tile: Tile, look: Stat = stat, recorded: Recorded = ()) -> TileGraph:
        """Return the graph of a tile, as configuration and sources are now (`Pattern.graph`)."""
        return self.pattern.graph(tile, self.checksum, look, recorded)

    def sightings(self) -> Stat:
        """Return what looks at many sources: those of a bucket by a list of each folder, once."""
        many = StatCache()
        # On disk a look costs next to nothing, and late is better than early.
        return lambda file: many(file) if is_remote(file) else stat(file)

    def job(self, graph: TileGraph, force: frozenset[str] = frozenset()) -> TileJob:
        """Return what a worker needs to do one tile."""
        return TileJob(graph, str(absolute(self.path)), str(absolute(self.store)), self.origin, force)

    def folder(self, tile_id: str) -> TileProducts:
        """Return where a tile's products are."""
        return TileProducts.of(self.path, tile_id)

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


def versions() -> dict[str, str]:
    """Return the versions of what computes, for the record."""
    found = {"python": platform.python_version()}
    for package in PACKAGES:
        try:
            found[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            found[package] = "not installed"
    return found


def _origin(catalog: Catalog) -> tuple[float, float]:
    corners = [tile.grid.origin for tile in catalog.tiles]
    return min(east for east, _ in corners), min(north for _, north in corners)


def _exported(record: dict[str, Any] | None, config: Config) -> tuple[str, ...]:
    before = (record or {}).get("exported", ())
    return tuple(dict.fromkeys([*before, *config.export.variants]))


def _config(where: Location) -> Config:
    seen = stat(where)
    if seen is not None and not seen.size:
        # It would be read as one that changes no default.
        raise ConfigError(f"{where} is empty, as a power failure leaves it; `flexroad run` writes it anew")
    if isinstance(where, Path):
        return load_config(where)
    return compose(yaml.safe_load(read(where)), str(where))


def _record(run: Location) -> dict[str, Any] | None:
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
