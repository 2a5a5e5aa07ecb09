"""Ground filters beside CSF and PDAL's PMF and SMRF, with default options, on real and synthetic clouds.

Real clouds are read from the folder FLEXROAD_REAL_DATA, PDAL is used if it is on the path; both are optional.
Ground is class 2. Noise (class 7) is removed first. Class 1 (unclassified) is filtered but not scored; all
other classes are objects. Synthetic clouds are the cells of the benchmark's surface models: bridges are
objects, plants and mixed echoes within 0.3 m of the ground are not scored.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import laspy
import numpy as np

from flexroad.tasks.types import Bools, Floats
from flexroad.tools.prepare.points import morphological
from flexroad.tools.prepare.points.ground_filter import Options, ground
from flexroad.tools.synthetic import Scene, gerod, make_scene
from flexroad.tools.synthetic.spoilers import BARE, Kind

SEED, TILES = 2, 24
SIDE_M = 500
VAGUE_M = 0.3
"""Plants and mixed echoes nearer to the ground than this are not scored."""
UNCLASSIFIED, GROUND, NOISE = 1, 2, 7
LOW_SHARE, LOW_M = 0.0005, (1.0, 8.0)
"""Low points added to a cloud: share of the points, and least and largest depth (m)."""


@dataclass(frozen=True, eq=False)
class Case:
    """A point cloud with known ground."""

    name: str
    points: Floats
    """Easting, northing and height, ``(n, 3)``, m."""
    truth: Bools
    """Ground points, ``(n,)``."""
    scored: Bools
    """Points that are scored, ``(n,)``."""


Filter = Callable[[Floats], Bools]


def main() -> None:
    cases = [*real(), *made()]
    both = {"slope": ours(Options()), "opening": opening(morphological.Options())}
    peers = {**both, **csf(), **pdal("pmf"), **pdal("smrf")}
    # The first call compiles.
    ours(Options())(cases[-1].points)
    print(f"{'':22} {'':9} {'type I':>7} {'type II':>7} {'total':>7} {'kappa':>6} {'s per M':>8}")
    for case in cases:
        for name, classify in peers.items():
            show(case, name, classify)
        if case.name.endswith("low points"):
            show(case, "low kept", ours(Options(low_m=None)))


def show(case: Case, name: str, classify: Filter) -> None:
    start = time.perf_counter()
    result = classify(case.points)
    seconds = (time.perf_counter() - start) / len(case.points) * 1e6
    first, second, total, kappa = errors(result, case)
    print(
        f"{case.name:22} {name:9} {first:7.2%} {second:7.2%} {total:7.2%} {kappa:6.3f} {seconds:8.2f}",
        flush=True,
    )


def errors(result: Bools, case: Case) -> tuple[float, float, float, float]:
    """Return the shares of rejected ground, of accepted objects and of all errors, and Cohen's kappa."""
    result, truth = result[case.scored], case.truth[case.scored]
    total = np.mean(result != truth)
    by_chance = np.mean(result) * np.mean(truth) + np.mean(~result) * np.mean(~truth)
    kappa = (1 - total - by_chance) / (1 - by_chance)
    return float(np.mean(~result[truth])), float(np.mean(result[~truth])), float(total), float(kappa)


def cells(scene: Scene) -> Floats:
    """Return the points of a surface model, one in the middle of each cell, ``(n, 3)``."""
    easting, northing = np.meshgrid(scene.grid.eastings, scene.grid.northings)
    return np.column_stack([easting.ravel(), northing.ravel(), scene.dsm.ravel()])


def ours(options: Options) -> Filter:
    return lambda points: ground(*np.ascontiguousarray(points.T), options)


def opening(options: morphological.Options) -> Filter:
    return lambda points: morphological.ground(*np.ascontiguousarray(points.T), options)


def csf() -> dict[str, Filter]:
    try:
        import CSF
    except ImportError:
        return {}

    def classify(points: Floats) -> Bools:
        cloth = CSF.CSF()
        cloth.setPointCloud(points)
        is_ground, others = CSF.VecInt(), CSF.VecInt()
        with Quiet():
            cloth.do_filtering(is_ground, others, False)
        out = np.zeros(len(points), bool)
        out[np.array(is_ground, dtype=int)] = True
        return out

    return {"CSF": classify}


class Quiet:
    """Suppress all output, also that of compiled code."""

    def __enter__(self) -> None:
        self.stdout, nowhere = os.dup(1), os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, 1)
        os.close(nowhere)

    def __exit__(self, *error: object) -> None:
        os.dup2(self.stdout, 1)
        os.close(self.stdout)


def pdal(name: str) -> dict[str, Filter]:
    if not shutil.which("pdal"):
        return {}

    def classify(points: Floats) -> Bools:
        with tempfile.TemporaryDirectory() as folder:
            source, target = Path(folder) / "in.las", Path(folder) / "out.las"
            las = laspy.create(point_format=6, file_version="1.4")
            las.header.scales, las.header.offsets = [1e-4] * 3, np.floor(points.min(axis=0))
            las.xyz = points
            # The filters need return numbers: every point is a single return.
            las.return_number[:] = las.number_of_returns[:] = 1
            las.write(source)
            subprocess.run(["pdal", "translate", source, target, name], check=True)
            return np.asarray(laspy.read(target).classification) == GROUND

    return {name.upper(): classify}


def real() -> Iterator[Case]:
    folder = os.environ.get("FLEXROAD_REAL_DATA")
    if not folder:
        print("FLEXROAD_REAL_DATA is not set: real clouds are left out")
        return
    for name, pattern in (("IGN", "l93_770500_6277500/*.laz"), ("St-Barth", "stbarth/*.laz")):
        clouds = [laspy.read(path) for path in sorted((Path(folder) / "ign_crops").glob(pattern))]
        points = np.concatenate([cloud.xyz for cloud in clouds])
        kind = np.concatenate([np.asarray(cloud.classification) for cloud in clouds])
        points, kind = points[kind != NOISE], kind[kind != NOISE]
        case = Case(name, points, kind == GROUND, kind != UNCLASSIFIED)
        yield case
        yield with_low_points(case)


def with_low_points(case: Case) -> Case:
    """Add points below others, as multipath echoes cause them; they are not scored."""
    rng = np.random.default_rng(SEED)
    low = case.points[rng.choice(len(case.points), round(LOW_SHARE * len(case.points)), replace=False)]
    low = low - np.column_stack([np.zeros((len(low), 2)), rng.uniform(*LOW_M, len(low))])
    none = np.zeros(len(low), bool)
    return replace(
        case,
        name=f"{case.name}, low points",
        points=np.vstack([case.points, low]),
        truth=np.concatenate([case.truth, none]),
        scored=np.concatenate([case.scored, none]),
    )


def made() -> Iterator[Case]:
    """Yield one square of the synthetic benchmark per stratum."""
    places = gerod.survey(TILES, SEED)
    for stratum in gerod.STRATA:
        grid, options = next((grid, options) for _, grid, name, options in places if name == stratum)
        grid = replace(grid, width=SIDE_M, height=SIDE_M)
        scene = make_scene(grid, SEED, stratum, options)
        points = cells(scene)
        truth = np.isin(scene.kind, BARE) & (scene.kind != Kind.DECK)
        vague = np.isin(scene.kind, (Kind.PLANTS, Kind.MIXED)) & (abs(scene.dsm - scene.reference) < VAGUE_M)
        yield Case(f"made, {stratum}", points, truth.ravel(), ~vague.ravel())


if __name__ == "__main__":
    main()
