"""The fits of many tiles together, for `pipeline.execute.batches`.

`prepare` computes a tile up to its fit and stores what the fit needs; `fit_together` reads that for many
tiles and stores their surfaces; `process_tile` then goes on with the surface from the store. What fails here
is left to `process_tile`, which computes the tile by itself and reports its errors.
"""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Sequence
from dataclasses import replace
from time import perf_counter
from typing import Any

from flexroad.catalog.storage.paths import parse_location
from flexroad.pipeline.config.cluster import Cluster
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.execute import Ready
from flexroad.pipeline.graph.graph import Node
from flexroad.pipeline.graph.stages import PROBLEM, in_batches, stage_module
from flexroad.pipeline.store.artefacts import ArtefactStore
from flexroad.pipeline.worker.evaluator import Evaluator
from flexroad.pipeline.worker.profiling import StageCost, utc_now
from flexroad.pipeline.worker.tile import Start, TileJob, TileResult, process_tile
from flexroad.tasks.errors import TaskError
from flexroad.tasks.spline.batch import Engine
from flexroad.tasks.spline.frame import Frame


def prepare(job: TileJob) -> Ready[TileJob] | TileResult:
    """Store what the fits of a tile need; without fits for a batch, return the tile's result."""
    evaluator = Evaluator(job.graph, ArtefactStore(parse_location(job.store)), job.force, keep=True)
    try:
        shapes = {node.fingerprint: _prepare_fit(evaluator, node) for node in _open_fits(job, evaluator)}
    except Exception:
        # The tile reports the error again, as a failure of its stage.
        shapes = {}
    if not shapes:
        return process_tile(job)
    start = Start(tuple(shapes), frozenset(evaluator.results) - shapes.keys(), dict(evaluator.spans))
    return Ready(replace(job, start=start), tuple(shapes.values()))


def _open_fits(job: TileJob, evaluator: Evaluator) -> list[Node]:
    """Return the fits to compute in a batch."""
    fits = [node for node in job.graph.nodes.values() if node.stage == "fit" and in_batches(node.options)]
    return [node for node in fits if "fit" in job.force or not evaluator.store.has(node)]


def _prepare_fit(evaluator: Evaluator, node: Node) -> tuple[Any, ...]:
    """Store the problem of a fit; return what the problems of a batch have in common."""
    inputs = [evaluator(name) for name in node.inputs]
    frame = Frame(*(evaluator(name) for name in node.frame)) if node.frame else None
    with evaluator.spans["fit"].measure():
        module: Any = stage_module(node.options)
        problem = module.tile_problem(*inputs, node.options, frame)
        evaluator.store.put(replace(node, stage=PROBLEM), problem, evaluator.seconds_before(node))
    return (node.options.model_dump_json(), problem.heights.shape)


def fit_together(cluster: Cluster, jobs: tuple[TileJob, ...]) -> list[TileJob]:
    """Fit the tiles of a batch, which have equal options and shapes, and store their surfaces.

    Raises
    ------
    ConfigError
        If this worker does not have the device.
    """
    try:
        device = Engine(cluster.device).chosen_device()
    except TaskError as error:
        raise ConfigError(f"cluster.device: {error}") from error
    engine = Engine(device, memory_bytes=memory_of_batch(cluster, device))
    done = list(jobs)
    for number in range(len(jobs[0].start.fits)):
        done = _fit(done, number, engine)
    return done


def memory_of_batch(cluster: Cluster, device: str) -> int:
    """Return what a batch may use (bytes): on the CPU at most half of its worker's memory by default."""
    if cluster.batch_memory or device != "cpu":
        return int(cluster.batch_memory or Engine.memory_bytes)
    from flexroad.pipeline.execute.memory import bytes_of_worker

    return min(Engine.memory_bytes, bytes_of_worker(cluster) // 2)


def _fit(jobs: Sequence[TileJob], number: int, engine: Engine) -> list[TileJob]:
    """Return the jobs with the state after the fit with this number."""
    nodes = [job.graph.nodes[job.start.fits[number]] for job in jobs]
    stores = [ArtefactStore(parse_location(job.store)) for job in jobs]
    begin = perf_counter()
    stored = [store.find(PROBLEM, node.fingerprint) for store, node in zip(stores, nodes, strict=True)]
    there = [i for i, found in enumerate(stored) if found]
    problems = [found[0] for found in stored if found]
    surfaces = dict(zip(there, solve(problems, nodes[0].options, engine), strict=True))
    share = (perf_counter() - begin) / len(jobs)
    done = list(jobs)
    for i, (job, node, store) in enumerate(zip(jobs, nodes, stores, strict=True)):
        found, surface = stored[i], surfaces.get(i)
        # Without space, for example, the tile is fitted by itself and reports the error.
        with contextlib.suppress(OSError):
            if found and surface is not None:
                size = store.put(node, surface, found[1] | {"fit": share})
                done[i] = replace(job, start=_after(job.start, node, share, size))
            store.remove(PROBLEM, node.fingerprint)
    return done


def _after(start: Start, node: Node, seconds: float, size: int) -> Start:
    """Return the state after a fit."""
    before = start.spans.get("fit", StageCost(utc_now()))
    span = replace(
        before, seconds=before.seconds + seconds, bytes=before.bytes + size, computed=before.computed + 1
    )
    return replace(start, computed=start.computed | {node.fingerprint}, spans=start.spans | {"fit": span})


def solve(problems: Sequence[Any], options: Any, engine: Engine) -> list[Any]:
    """Return the surface of each problem; None where the fit fails also without the others.

    A batch that fails, for example without enough memory on the GPU, is halved.
    """
    try:
        surfaces: list[Any] = stage_module(options).solve(problems, options, engine) if problems else []
        return surfaces
    except Exception:
        if len(problems) == 1:
            return [None]
    # After the error is gone: it holds the arrays of the batch.
    if engine.chosen_device() != "cpu":
        sys.modules["torch"].cuda.empty_cache()
    half = len(problems) // 2
    return [*solve(problems[:half], options, engine), *solve(problems[half:], options, engine)]
