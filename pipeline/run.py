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
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import yaml

from catalog import Catalog, Tile
from pipeline.config import Config, load_config
from pipeline.errors import ConfigError
from pipeline.execute import Executor
from pipeline.graph import TileGraph, model_files, tile_graph, tile_graphs
from pipeline.store import TileFolder, check_writable, write_atomic
from pipeline.tables import write_tables
from pipeline.warm import warm
from pipeline.work import Failure, Job, TileResult, do_tile, failed_row, give_up

PACKAGES = ("flexroad", "numpy", "scipy", "numba", "rasterio", "startinpy", "dask", "torch")


@dataclass(frozen=True)
class Run:
    """An opened run folder."""

    path: Path
    config: Config
    catalog: Catalog
    store: Path
    origin: tuple[float, float]
    """Whole-metre (easting, northing) all meshes are placed against; fixed when the run is made."""
    checksum: bool
    versions: dict[str, str]

    @classmethod
    def create(
        cls, path: Path, config: Config, catalog: Catalog, store: Path | None = None, checksum: bool = False
    ) -> Run:
        """Make a run folder, or bring an old one up to date with a new configuration or catalog.

        Raises
        ------
        ConfigError
            If the folder or the store cannot be written, or a model is missing.
        """
        check_models(config)
        old = _record(path)
        origin = old["origin"] if old else _origin(catalog)
        store = store or (Path(old["store"]) if old and old["shared_store"] else path / "store")
        run = cls(path, config, catalog, store, (origin[0], origin[1]), checksum, versions())
        try:
            for folder in (path, store):
                folder.mkdir(parents=True, exist_ok=True)
                check_writable(folder)
            run._write()
        except OSError as error:
            raise ConfigError(
                f"cannot write the run to {path}: {error}; choose another --out or --store"
            ) from error
        return run

    @classmethod
    def open(cls, path: Path) -> Run:
        """Open a run made before, with its configuration and catalog as they are now.

        Raises
        ------
        ConfigError
            If the folder is no run, or its configuration was edited into something invalid.
        CatalogError
            If its catalog is damaged.
        """
        found = _record(path)
        if found is None:
            raise ConfigError(
                f"{path} is no run: it has no sound run.json; make one with `flexroad run --out {path}`"
            )
        store = Path(found["store"]) if found["shared_store"] else path / "store"
        config = load_config(path / "config.yaml").model_copy(update={"name": found["config"]})
        catalog = Catalog.read(path / "catalog.parquet")
        origin = (found["origin"][0], found["origin"][1])
        return cls(path, config, catalog, store, origin, found["checksum"], found["versions"])

    def graphs(self) -> Iterator[TileGraph]:
        """Yield the graph of every tile, as configuration and sources are now.

        Sources that are gone count as they were when the tile was done: what was made from them stands.
        """
        for tile in self.catalog.tiles:
            yield tile_graph(tile, self.config, self.checksum, self.folder(tile.id).sources)

    def job(self, graph: TileGraph, anew: frozenset[str] = frozenset()) -> Job:
        """Return what a worker needs to do one tile."""
        return Job(graph, str(self.path.resolve()), str(self.store.resolve()), self.origin, anew)

    def folder(self, tile_id: str) -> TileFolder:
        """Return where a tile's products are."""
        return TileFolder.of(self.path, tile_id)

    def log(self, event: str, **what: Any) -> None:
        """Append one event to log.jsonl."""
        line = {"time": datetime.now(UTC).isoformat(timespec="milliseconds"), "event": event, **what}
        # A disk too full for the log is no reason to stop the tiles.
        with contextlib.suppress(OSError), (self.path / "log.jsonl").open("a") as file:
            file.write(json.dumps(line) + "\n")

    def _write(self) -> None:
        write_atomic(self.path / "config.yaml", yaml.safe_dump(self.config.raw, sort_keys=False).encode())
        self.catalog.write(self.path / "catalog.parquet", movable=False)
        found = {
            "config": self.config.name,
            "store": str(self.store.resolve()),
            "shared_store": self.store.resolve() != (self.path / "store").resolve(),
            "origin": list(self.origin),
            "checksum": self.checksum,
            "versions": self.versions,
        }
        write_atomic(self.path / "run.json", json.dumps(found, indent=1).encode())


@dataclass(frozen=True)
class Summary:
    """How a run stands, over all its tiles."""

    tiles: int
    done: int
    """Tiles with results, those of earlier runs included."""
    failed: int
    cached: int
    """Of those done, how many the last run found done already."""
    pending: int
    new: int
    """Tiles the last run saw for the first time."""
    changed: int
    """Tiles whose sources or options the last run found changed."""
    vanished: int
    """Tiles that the catalog no longer had when the last run began."""
    seconds: float
    """How long the last run took."""
    failures: tuple[Failure, ...]


def execute(
    run: Run,
    executor: Executor,
    only: Callable[[Tile], bool] = lambda tile: True,
    anew: frozenset[str] = frozenset(),
    watch: Callable[[TileResult], None] = lambda result: None,
) -> Summary:
    """Bring the run's tiles up to date and write the tables.

    Parameters
    ----------
    only : callable
        Which tiles; the tables are over all of them.
    anew : frozenset of str
        Stages to compute even if the store has them.
    watch : callable
        Told of every result as it comes.

    Raises
    ------
    ConfigError
        If a model is missing.
    OSError
        If the tables cannot be written, as on a full disk.
    """
    check_models(run.config)
    start = time.perf_counter()
    results: list[TileResult] = []

    def note(result: TileResult) -> None:
        run.log("tile", **_event(result))
        watch(result)
        # The marker keeps the rows of what is done; over a state they would fill the memory here.
        results.append(result if result.failures else replace(result, rows=()))

    def jobs() -> Iterator[Job]:
        cold = True
        # Unlike `Run.graphs`: who wants a tile done wants to know that its sources are gone.
        for graph in tile_graphs(run.catalog, run.config, run.checksum):
            if not only(graph.tile):
                continue
            if not anew and run.folder(graph.tile.id).done(graph):
                note(TileResult(graph.tile.id, "cached", ()))
                continue
            if cold:
                warm(run.config)
                cold = False
            yield run.job(graph, anew)

    run.log("run", tiles=len(run.catalog.tiles), config=run.config.name, versions=run.versions)
    try:
        for result in executor.map(do_tile, jobs(), _lost):
            note(result)
    finally:
        # Also after an interruption: what is done is in the tables.
        write_tables(run.path, *outcome(run, results))
        run.log("end", seconds=round(time.perf_counter() - start, 3))
    return summary(run, results)


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


def outcome(run: Run, results: Sequence[TileResult] = ()) -> tuple[list[dict[str, Any]], list[Failure]]:
    """Return the rows and failures of all tiles that were tried, in the catalog's order.

    Of tiles without a marker ``results`` tells: a full disk leaves none.
    """
    fresh = {result.tile_id: result for result in results}
    rows: list[dict[str, Any]] = []
    failures: list[Failure] = []
    for graph in run.graphs():
        folder = run.folder(graph.tile.id)
        item = folder.done(graph)
        if item is not None:
            rows += item["properties"]["flexroad:rows"]
            continue
        failure = folder.failed(graph)
        if failure is not None:
            rows += failure["rows"]
            failures += [Failure(**fault) for fault in failure["failures"]]
        elif graph.tile.id in fresh:
            rows += fresh[graph.tile.id].rows
            failures += fresh[graph.tile.id].failures
    return rows, failures


def summary(run: Run, results: Sequence[TileResult] = ()) -> Summary:
    """Return how the run stands now, by its markers and, for tiles that could write none, by ``results``."""
    rows, failures = outcome(run, results)
    failed = {failure.tile_id for failure in failures}
    done = {row["tile_id"] for row in rows} - failed
    total = len(run.catalog.tiles)
    cached = _cached(run.path / "log.jsonl") & done
    return Summary(
        total,
        len(done),
        len(failed),
        len(cached),
        total - len(done) - len(failed),
        0,
        0,
        0,
        0.0,
        tuple(failures),
    )


def select(run: Run, tiles: Sequence[str], failed: bool) -> Callable[[Tile], bool]:
    """Return which tiles a rerun means: those named, those failed, both, or all.

    Raises
    ------
    CatalogError
        If a tile is not in the run's catalog.
    """
    named = {tile.id for tile in run.catalog.select(tiles).tiles} if tiles else set()

    def chosen(tile: Tile) -> bool:
        if tile.id in named or not (named or failed):
            return True
        # Whatever it failed of: a file mended since is why it is tried again.
        return failed and run.folder(tile.id).gave_up()

    return chosen


def asked(path: Path, whole: Catalog, wanted: Catalog) -> Catalog:
    """Return the tiles a run is about when some tiles of a catalog are asked for.

    Those, and those it was asked for before that the catalog still has: their results stay in the tables.
    """
    record = path / "catalog.parquet"
    before = {tile.id for tile in Catalog.read(record).tiles} if record.exists() else set()
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
    rows = tuple(failed_row(graph, variant, failure.line) for variant in graph.variants)
    give_up(job, rows, [failure])
    return TileResult(graph.tile.id, "failed", rows, (failure,))


def _event(result: TileResult) -> dict[str, Any]:
    found: dict[str, Any] = {
        "tile": result.tile_id,
        "status": result.status,
        "computed": result.computed,
        "reused": result.reused,
        "seconds": {stage: round(value, 4) for stage, value in result.seconds.items()},
        "pid": result.pid,
        "peak_mb": round(result.peak_mb, 1),
    }
    if result.notes:
        found["notes"] = list(result.notes)
    if result.failures:
        found["failures"] = [asdict(failure) for failure in result.failures]
    return found


def _cached(log: Path) -> set[str]:
    cached: set[str] = set()
    if not log.exists():
        return cached
    with log.open() as lines:
        for line in lines:
            try:
                event = json.loads(line)
            except ValueError:
                # The last line of a run that was killed may be cut off.
                continue
            match event:
                case {"event": "run"}:
                    cached.clear()
                case {"event": "tile", "status": "cached", "tile": tile}:
                    cached.add(tile)
    return cached


def _origin(catalog: Catalog) -> tuple[float, float]:
    corners = [tile.grid.origin for tile in catalog.tiles]
    return min(east for east, _ in corners), min(north for _, north in corners)


def _record(run: Path) -> dict[str, Any] | None:
    """Return what run.json holds, or None if it is not there or damaged."""
    try:
        found: dict[str, Any] = json.loads((run / "run.json").read_text())
    except (OSError, ValueError):
        return None
    known = {"config", "store", "shared_store", "origin", "checksum", "versions"}
    return found if isinstance(found, dict) and known <= found.keys() else None
