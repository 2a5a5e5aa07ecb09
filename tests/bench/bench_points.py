"""``prepare points`` on a real survey: points per second and peak memory, compared with decoding alone.

Every row is measured in a separate process. Four files are four copies of the same survey, side by side:
memory should not grow with their number.
"""

from __future__ import annotations

import contextlib
import json
import os
import resource
import struct
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

SURVEY = Path("autzen") / "autzen_north.laz"
THIN = Path("autzen") / "autzen-thin.las"
OFFSET_EAST, MAX_EAST, MIN_EAST = 155, 179, 187
"""Byte offsets in the header of a LAS file; changing these values moves the cloud."""
STEP_FEET = 3400.0
TASKS = ("decode", "serial", "dask")
EVERY_S = 0.1
"""Interval of memory measurements."""


def main() -> None:
    folder = os.environ.get("FLEXROAD_REAL_DATA")
    if not folder:
        print("FLEXROAD_REAL_DATA is not set: nothing is measured")
        return
    with tempfile.TemporaryDirectory() as scratch:
        files = side_by_side(Path(folder) / SURVEY, Path(scratch), 4)
        print(f"\n{SURVEY}: {files[0].stat().st_size / 1e6:.0f} MB, {os.cpu_count()} cores")
        print("  task     files     points  seconds  points/s   peak MB  largest worker MB")
        for task in TASKS:
            for subset in (files[:1], files):
                run = measure(task, subset, Path(folder) / THIN, Path(scratch))
                print(
                    f"  {task:8}{len(subset):6}{run['points']:12,}{run['seconds']:9.1f}"
                    f"{run['points'] / run['seconds']:10,.0f}{run['peak']:10.0f}{run['worker']:19.0f}"
                )


def side_by_side(survey: Path, folder: Path, number: int) -> list[Path]:
    """Write copies of a cloud, each east of the one before, and return their paths."""
    paths = []
    for index in range(number):
        raw = bytearray(survey.read_bytes())
        for offset in (OFFSET_EAST, MAX_EAST, MIN_EAST):
            struct.pack_into("<d", raw, offset, struct.unpack_from("<d", raw, offset)[0] + index * STEP_FEET)
        paths.append(folder / f"{index}.laz")
        paths[-1].write_bytes(raw)
    return paths


def measure(task: str, files: list[Path], thin: Path, folder: Path) -> dict[str, float]:
    out = tempfile.mkdtemp(dir=folder)
    call = [sys.executable, __file__, task, out, str(thin), *map(str, files)]
    root = str(Path(__file__).parents[2])
    done = subprocess.run(
        call, check=True, capture_output=True, text=True, env={**os.environ, "PYTHONPATH": root}
    )
    result: dict[str, float] = json.loads(done.stdout.splitlines()[-1])
    return result


def measure_here(task: str, out: Path, thin: Path, files: list[Path]) -> None:
    """Run one task in this process and print its measurements as JSON."""
    if task == "decode":
        work = decode
    else:
        work = prepare
        # Compiled code is loaded before timing starts.
        prepare("serial", [thin], out / "warm", cell=20)
    worker = [0.0]
    threading.Thread(target=watch, args=(worker,), daemon=True).start()
    start = time.perf_counter()
    work(task, files, out / "out")
    seconds = time.perf_counter() - start
    own = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    points = sum(map(header_points, files))
    print(json.dumps({"seconds": seconds, "points": points, "peak": own, "worker": worker[0]}))


def watch(worker: list[float]) -> None:
    """Store the largest memory of a child process (MB); ``ru_maxrss`` would include the parent's."""
    import psutil

    while True:
        for child in psutil.Process().children(recursive=True):
            with contextlib.suppress(psutil.Error):
                worker[0] = max(worker[0], child.memory_info().rss / 2**20)
        time.sleep(EVERY_S)


def header_points(path: Path) -> int:
    import laspy

    with laspy.open(path) as reader:
        return int(reader.header.point_count)


def decode(task: str, files: list[Path], out: Path) -> None:
    """Only decode the coordinates, with laspy, in parallel."""
    import laspy
    import numpy as np

    for path in files:
        with laspy.open(path, laz_backend=laspy.LazBackend.LazrsParallel) as reader:
            for points in reader.chunk_iterator(1_000_000):
                for axis in (points.x, points.y, points.z):
                    np.asarray(axis)


def prepare(task: str, files: list[Path], out: Path, cell: float = 1) -> None:
    from flexroad.pipeline.execute import DaskExecutor, SerialExecutor
    from flexroad.pipeline.prepare.options import PrepareOptions
    from flexroad.pipeline.prepare.points import prepare_points
    from flexroad.tasks.acquire.points.to_rasters import Options

    executor = DaskExecutor() if task == "dask" else SerialExecutor()
    common = PrepareOptions(crs="EPSG:2994", cell_m=cell, tile_size_m=500)
    prepare_points(files, out, common, Options(), executor, lambda _: None)


if __name__ == "__main__":
    if len(sys.argv) > 1:
        measure_here(sys.argv[1], Path(sys.argv[2]), Path(sys.argv[3]), [Path(name) for name in sys.argv[4:]])
    else:
        main()
