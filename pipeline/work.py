"""What happens to one tile: pull what is asked for through its graph, keep it, say how it went.

Results are pulled, not pushed: a stage runs only if something asked for needs it and the store does not
have it. Runs in a worker process; only small rows go back.
"""

from __future__ import annotations

import contextlib
import os
import resource
import time
import traceback
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal

from catalog import Tile
from catalog.index import item
from pipeline.graph import STAGE_NAMES, Node, TileGraph, stage_module
from pipeline.products import products
from pipeline.store import Store, TileFolder, file_entry, no_nan
from tasks.errors import TaskError
from tasks.types import Metrics, Quality

Row = dict[str, Any]
QUALITY = tuple(name for name, kind in Quality.__annotations__.items() if kind == "float")
"""Figures of a row that need no ground truth."""
Status = Literal["done", "failed", "cached"]


@dataclass(frozen=True)
class Job:
    """One tile to do, and where its results go; travels to a worker."""

    graph: TileGraph
    run: str
    store: str
    origin: tuple[float, float]
    """Whole-metre (easting, northing) that all meshes of the run are placed against."""
    anew: frozenset[str] = frozenset()
    """Stages to compute even if the store has them."""


@dataclass(frozen=True)
class Failure:
    """Why a tile has no result."""

    tile_id: str
    stage: str
    kind: str
    message: str
    file: str = ""
    trace: str = ""
    """The traceback, for faults that are not the input's."""

    @property
    def line(self) -> str:
        """One line for tables."""
        return f"{self.stage}: {self.kind}: {self.message}"

    @property
    def notice(self) -> str:
        """One line for people: tile, what is wrong, and the file at fault."""
        return f"{self.tile_id}: {self.line}{f'  [{self.file}]' if self.file else ''}"


@dataclass(frozen=True)
class TileResult:
    """How one tile went; what travels back."""

    tile_id: str
    status: Status
    rows: tuple[Row, ...]
    failures: tuple[Failure, ...] = ()
    computed: dict[str, int] = field(default_factory=dict)
    """Stage -> how many of its nodes were computed now."""
    reused: dict[str, int] = field(default_factory=dict)
    """Stage -> how many of its nodes came from the store."""
    seconds: dict[str, float] = field(default_factory=dict)
    """Stage -> time spent computing now."""
    notes: tuple[str, ...] = ()
    pid: int = 0
    peak_mb: float = 0.0


class StageError(Exception):
    """A stage failed; carries what the table of failures needs."""

    def __init__(self, failure: Failure) -> None:
        super().__init__(failure.line)
        self.failure = failure


@dataclass
class Pull:
    """Results of one tile's nodes, each computed or read at most once."""

    graph: TileGraph
    store: Store
    anew: frozenset[str] = frozenset()
    keep: bool = False
    """Whether to put into the store what is computed; who only looks at a run leaves it as it is."""
    results: dict[str, Any] = field(default_factory=dict)
    chain_seconds: dict[str, dict[str, float]] = field(default_factory=dict)
    computed: Counter[str] = field(default_factory=Counter)
    reused: Counter[str] = field(default_factory=Counter)
    seconds: defaultdict[str, float] = field(default_factory=lambda: defaultdict(float))
    faults: dict[str, StageError] = field(default_factory=dict)

    def __call__(self, fingerprint: str) -> Any:
        """Return the node's result.

        Raises
        ------
        StageError
            If it or something it needs failed, now or before.
        """
        if fingerprint in self.faults:
            raise self.faults[fingerprint]
        if fingerprint not in self.results:
            node = self.graph.nodes[fingerprint]
            found = self.store.get(node) if node.stored and node.stage not in self.anew else None
            if found is None:
                self._compute(node)
            else:
                self.results[fingerprint], self.chain_seconds[fingerprint] = found
                self.reused[node.stage] += 1
        return self.results[fingerprint]

    def _compute(self, node: Node) -> None:
        inputs = [self(fingerprint) for fingerprint in node.inputs] or [self.graph.tile]
        start = time.perf_counter()
        try:
            result = node.function(*inputs, node.options)
        except Exception as error:
            failed = StageError(_failure(self.graph.tile, node.stage, error))
            self.faults[node.fingerprint] = failed
            raise failed from error
        took = time.perf_counter() - start
        self.computed[node.stage] += 1
        self.seconds[node.stage] += took
        known = [self.chain_seconds[fingerprint] for fingerprint in node.inputs]
        spent = {stage: value for seconds in known for stage, value in seconds.items()} | {node.stage: took}
        self.results[node.fingerprint], self.chain_seconds[node.fingerprint] = result, spent
        if node.stored and self.keep:
            self._keep(node, result, spent)

    def _keep(self, node: Node, result: Any, spent: Mapping[str, float]) -> None:
        try:
            self.store.put(node, result, spent)
        except OSError as error:
            # The same for every artefact: a full disk is one failure, not one for each variant.
            full = OSError(error.errno, error.strerror, str(self.store.root))
            failed = StageError(_failure(self.graph.tile, "store", full))
            self.faults[node.fingerprint] = failed
            raise failed from error


def do_tile(job: Job) -> TileResult:
    """Bring one tile up to date with its graph; never raises for what is one tile's own fault."""
    graph, folder = job.graph, TileFolder.of(Path(job.run), job.graph.tile.id)
    pull = Pull(graph, Store(Path(job.store)), job.anew, keep=True)
    rows, failures = [], []
    for variant in graph.variants:
        try:
            rows.append(_row(graph, variant, pull))
        except StageError as error:
            rows.append(failed_row(graph, variant, error.failure.line))
            failures.append(error.failure)
    failures = list(dict.fromkeys(failures))
    notes = tuple(dict.fromkeys(note for fp, node in graph.nodes.items() for note in _noted(fp, node, pull)))
    if not failures:
        try:
            _finish(job, folder, pull, rows, notes)
        except StageError as error:
            failures.append(error.failure)
        except Exception as error:
            failures.append(_failure(graph.tile, "export", error))
        if failures:
            rows = [failed_row(graph, row["variant"], failures[0].line) for row in rows]
    if failures:
        give_up(job, rows, failures)
    return TileResult(
        graph.tile.id,
        "failed" if failures else "done",
        tuple(rows),
        tuple(failures),
        dict(pull.computed),
        dict(pull.reused),
        dict(pull.seconds),
        notes,
        os.getpid(),
        resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
    )


def give_up(job: Job, rows: Sequence[Row], failures: Sequence[Failure]) -> None:
    """Write down that the tile failed, and why."""
    found = {
        "tile": job.graph.tile.id,
        "fingerprint": job.graph.fingerprint,
        "failures": [asdict(failure) for failure in failures],
        "rows": list(rows),
    }
    # Where even this cannot be written (disk full), the rows that go back still tell.
    with contextlib.suppress(OSError):
        TileFolder.of(Path(job.run), job.graph.tile.id).fail(found)


def failed_row(graph: TileGraph, variant: str, error: str) -> Row:
    """Return the row of a variant without figures."""
    return (
        _head(graph, variant, "failed")
        | dict.fromkeys((*Metrics.__annotations__, *QUALITY))
        | {"seconds": None, "error": error, "flags": ""}
    )


def _row(graph: TileGraph, variant: str, pull: Pull) -> Row:
    evaluated = graph.variants[variant]["evaluate"]
    figures = asdict(pull(evaluated))
    quality: Quality = pull(graph.variants[variant]["assess"])
    figures |= {name: getattr(quality, name) for name in QUALITY}
    seconds = sum(pull.chain_seconds[evaluated].values())
    told = {"seconds": seconds, "error": "", "flags": ", ".join(quality.flags)}
    return no_nan(_head(graph, variant, "done") | figures | told)


def _head(graph: TileGraph, variant: str, status: Status) -> Row:
    fit = graph.chain(variant)[STAGE_NAMES.index("fit")]
    return {
        "tile_id": graph.tile.id,
        "variant": variant,
        "method": fit.options.model_dump()["method"],
        "stratum": graph.tile.stratum,
        "status": status,
    }


def _noted(fingerprint: str, node: Node, pull: Pull) -> tuple[str, ...]:
    """Return what a stage that reads sources had to say of them, as far as it was asked."""
    if node.stage not in ("load", "segment") or fingerprint not in pull.results:
        return ()
    notes: tuple[str, ...] = pull.results[fingerprint].notes
    return notes


def _finish(job: Job, folder: TileFolder, pull: Pull, rows: list[Row], notes: tuple[str, ...]) -> None:
    start = time.perf_counter()
    made = products(job.graph, pull, job.origin)
    folder.finish(_item(job.graph, rows, made, notes), {name: data for name, (data, _) in made.items()})
    pull.computed["export"] += 1
    pull.seconds["export"] += time.perf_counter() - start


def _item(
    graph: TileGraph, rows: list[Row], made: Mapping[str, tuple[bytes, str]], notes: tuple[str, ...]
) -> dict[str, Any]:
    found = item(graph.tile)
    found["stac_extensions"].append("https://stac-extensions.github.io/file/v2.1.0/schema.json")
    found["assets"] = {name: file_entry(name, data, kind) for name, (data, kind) in made.items()}
    found["properties"] |= {
        "created": datetime.now(UTC).isoformat(),
        "flexroad:fingerprint": graph.fingerprint,
        "flexroad:rows": rows,
        "flexroad:notes": list(notes),
        "flexroad:nodes": graph.variants,
        "flexroad:sources": graph.sources,
        "flexroad:versions": _versions(graph),
    }
    return found


def _versions(graph: TileGraph) -> dict[str, int]:
    modules = [stage_module(node.options) for node in graph.nodes.values()]
    return {module.__name__: module.VERSION for module in modules}


def _failure(tile: Tile, stage: str, error: BaseException) -> Failure:
    message = " ".join(str(error).split()) or repr(error)
    expected = isinstance(error, TaskError | OSError)
    file = _file(tile, error) if isinstance(error, TaskError) else str(getattr(error, "filename", "") or "")
    trace = "" if expected else "".join(traceback.format_exception(error))
    return Failure(tile.id, stage, type(error).__name__, message, file, trace)


def _file(tile: Tile, error: TaskError) -> str:
    layer = tile.layer(error.layer)
    return error.file or (str(tile.paths(layer)[0]) if layer else "")
