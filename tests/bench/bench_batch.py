"""Fits per second of the batched production fit against the size of batches, its memory and its parity.

With a GPU: ``python tests/bench/bench_batch.py --device cuda --precision float32 --batch 1 64 256``.
Times are of `fit_batch` as a whole, with the preparation of each tile on the CPU. CUDA is untested.

Counted work of one step of one tile, with H x W cells, M x N control points and L = degree + 1, in flops:

- normal equations: ``2 M L H W + 2 M L W N L``, two products with pairs of basis functions;
- one iteration of conjugate gradients: ``2 (2 L - 1)^2 M N`` for the matrix, and
  ``4 (M N M' + M' N N')`` for each coarser spline of M' x N' control points;
- surface, gradient and change at the cells: three times ``2 M N W + 2 M H W``.

Bytes of one product with the matrix without a cache: four reads or writes for each of ``(2 L - 1)^2`` terms,
``4 (2 L - 1)^2 M N`` numbers. With a kernel that reads the stencil once it is ``(L^2 + 2) M N``.
"""

from __future__ import annotations

import argparse
import os

os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")

import resource
import time
from collections.abc import Callable

import numpy as np
import torch

from flexroad.catalog.grid import Grid
from flexroad.tasks.fit import smoothing_spline
from flexroad.tasks.spline.batch import Engine
from flexroad.tasks.synthetic import make_scene
from flexroad.tasks.types import RoadClusters, TileData

OPTIONS = smoothing_spline.Options()


def tile(size: int, seed: int) -> tuple[TileData, RoadClusters, None]:
    """Return a made tile with its true road, and every fifth with a void."""
    grid = Grid("EPSG:25832", 500000.0, 5600000.0, 1.0, size, size)
    scene = make_scene(grid, seed, ("urban", "suburban", "rural")[seed % 3])
    dsm, dtm = scene.dsm.copy(), scene.dtm.copy()
    if seed % 5 == 0:
        void = slice(size // 4, size // 2), slice(size // 4, size // 2)
        dsm[void] = dtm[void] = np.nan
    data = TileData("bench", grid, grid, dsm, dtm)
    return data, RoadClusters(grid, scene.road_mask.astype(np.int32)), None


def best(function: Callable[[], object], device: str, rounds: int) -> float:
    """Return the shortest time of several calls (s): CPU time, or wall time with a GPU."""
    clock = time.process_time if device == "cpu" else time.perf_counter
    times = []
    for _ in range(rounds):
        start = clock()
        function()
        if device != "cpu":
            torch.cuda.synchronize()
        times.append(clock() - start)
    return min(times)


def memory_mb(device: str) -> float:
    """Return the largest memory so far: of the device, or of this process (MB)."""
    if device == "cpu":
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return torch.cuda.max_memory_allocated() / 1e6


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--precision", default="float64", choices=["float64", "float32"])
    parser.add_argument("--batch", type=int, nargs="+", default=[1, 4, 16])
    parser.add_argument("--size", type=int, default=250, help="cells along each axis")
    parser.add_argument("--rounds", type=int, default=3)
    args = parser.parse_args()
    engine = Engine(args.device, args.precision, memory_bytes=2**62)
    tiles = [tile(args.size, seed) for seed in range(max(args.batch))]
    single = [smoothing_spline.fit(data, clusters, OPTIONS) for data, clusters, _ in tiles]
    seconds = best(lambda: [smoothing_spline.fit(*some[:2], OPTIONS) for some in tiles], "cpu", args.rounds)
    print(f"one after the other: {len(tiles) / seconds:.1f} fits/s (CPU)")
    for size in args.batch:
        some = tiles[:size]
        surfaces = smoothing_spline.fit_batch(some, OPTIONS, engine)
        seconds = best(
            lambda some=some: smoothing_spline.fit_batch(some, OPTIONS, engine), args.device, args.rounds
        )
        at = tiles[0][0].core.eastings, tiles[0][0].core.northings
        off = max(
            np.abs(one.lattice(*at) - other.lattice(*at)).max()
            for one, other in zip(single[:size], surfaces, strict=True)
        )
        print(
            f"batch {size}: {size / seconds:.1f} fits/s, at most {1e3 * off:.2f} mm off, "
            f"memory {memory_mb(args.device):.0f} MB"
        )


if __name__ == "__main__":
    main()
