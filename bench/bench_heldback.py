"""Errors at points and cells withheld from DSM and DTM: both configurations, real places and synthetic scans.

Squares of 5 m (`SIDE_M`) are taken out of the points or cells of a place, the place is prepared and run, and
the surface is compared with what was taken out. Points count if they are ground: by their class or, without
classes, within 0.3 m of the terrain model of all points. Synthetic scans have a scanner's noise, and are
compared with the true surface.

The error estimates of the road's squares are compared with their errors: how many squares have a mean error
within the 90% interval, and how many of the worst tenth are among the tenth with the largest estimate.

Small places have few such squares, so they are run with several draws of them (`DRAWN`), pooled.

Usage: ``python bench/bench_heldback.py [PLACE ...] [--set NAME=OPTION=VALUE ...] [--draw NUMBER]``;
each NAME is a further configuration, production with options: ``--set soft=fit.bending_m3=20``. Another
number of the first draw gives other squares and other synthetic scenes. Real places need FLEXROAD_REAL_DATA.
Intervals are 95% intervals of a bootstrap over the squares, for MAD and T over the tiles.
"""

from __future__ import annotations

import argparse
import os
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import laspy
import numpy as np
import rasterio
from scipy.ndimage import map_coordinates

import flexroad
from bench.towns import ARCHIVES, PAVED, Town
from flexroad.catalog import Catalog, Grid
from flexroad.tasks.quality.estimate import INTERVAL
from flexroad.tasks.types import Bools, Floats
from flexroad.tools.export.source import select
from flexroad.tools.prepare.points.to_rasters import Options
from flexroad.tools.synthetic import SceneOptions, make_scene, prepared
from flexroad.tools.synthetic.scene import DECK, GROUND, scan
from tests.command_line import call
from tests.make_clouds import rasterise

SIDE_M, SHARE, FIRST = 5.0, 0.06, 7
"""Side of the squares, the share of them that is withheld, and the number of the first draw."""
DRAWN = {"IGN": 6, "Brighton Beach": 6}
"""Number of draws of a place, else 1."""
NEAR_M = 0.3
"""Points without classes are ground within this distance of the terrain model of all points."""
FOOT_M = 0.3048
CONFIGS = {
    "paper": ("paper", ()),
    "dsm": ("production", ("load.road_height=dsm",)),
    "production": ("production", ()),
}
"""Configurations: the paper's, production fitted to the DSM, and production."""
DRAWS = 2000
FEWEST_IN_SQUARE = 5
"""Smallest number of withheld points of a square whose mean error is compared with its estimate."""
Figure = Callable[[Floats], Floats]
Configs = dict[str, tuple[str, Sequence[str]]]
"""Name -> shipped configuration, and options that are set."""


@dataclass(frozen=True, eq=False)
class Truth:
    """What was withheld."""

    x: Floats
    y: Floats
    z: Floats
    road: Bools
    square: Floats
    """Number of the square of each point: errors in a square are alike."""


@dataclass(frozen=True, eq=False)
class Place:
    """A catalog of which parts were withheld, and these parts."""

    catalog: Path
    truth: Truth


Maker = Callable[[Path, int], Place]


@dataclass(frozen=True, eq=False)
class Compared:
    """A configuration's errors and error estimates at what was withheld, and the figures of its tiles."""

    errors: Floats
    estimates: Floats
    """Of the squares."""
    mad: Floats
    triangles: Floats


def squares(x: Floats, y: Floats, draw: int) -> tuple[Floats, Bools]:
    """Return the number of the square of each point, and whether it is withheld."""
    column, row = (np.floor(np.asarray(axis) / SIDE_M).astype(np.int64) for axis in (x, y))
    number = column * 10**7 + row
    # A hash of the number: which squares are withheld does not depend on the others.
    mixed = ((number * np.int64(2654435761) + draw) ^ (number >> 7)) % 1_000_003
    mixed = (mixed * 48271 + draw) % 1_000_003
    return number, mixed < SHARE * 1_000_003


def bilinear(path: Path, x: Floats, y: Floats, nearest: bool = False) -> Floats:
    """Return the values of a raster at points."""
    with rasterio.open(path) as raster:
        values = raster.read(1).astype(np.float64)
        columns, rows = ~raster.transform * (np.asarray(x), np.asarray(y))
    at = (np.asarray(rows) - 0.5, np.asarray(columns) - 0.5)
    found: Floats = map_coordinates(values, at, order=0 if nearest else 1, mode="nearest")
    return found


def scanned(
    files: Sequence[Path], options: Sequence[object], folder: Path, draw: int, unit: float = 1.0
) -> Place:
    """Withhold points of a scan and prepare it without them."""
    common = (*options, "--workers", 1, "-o")
    call("prepare", *files, *common, folder / "whole").expected(0)
    clouds = [laspy.read(file) for file in files]
    x, y, z = (np.concatenate([np.asarray(cloud[a]) for cloud in clouds]) * unit for a in "xyz")
    kind = np.concatenate([np.asarray(cloud.classification) for cloud in clouds])
    number, out = squares(x, y, draw)
    start = 0
    for file, cloud in zip(files, clouds, strict=True):
        kept = ~out[start : start + len(cloud.points)]
        start += len(cloud.points)
        left = laspy.LasData(cloud.header, cloud.points[kept])
        (folder / "points").mkdir(exist_ok=True)
        left.write(folder / "points" / file.name)
    kept_files = [folder / "points" / file.name for file in files]
    call("prepare", *kept_files, *common, folder / "left").expected(0)
    dtm, mask = folder / "whole" / "dtm.tif", folder / "whole" / "road_mask.tif"
    has_classes = (kind == GROUND).mean() > 0.01
    ground = np.isin(kind, (GROUND, DECK)) if has_classes else np.abs(bilinear(dtm, x, y) - z) < NEAR_M

    chosen = out & ground
    road = bilinear(mask, x[chosen], y[chosen], nearest=True) > 0
    truth = Truth(x[chosen], y[chosen], z[chosen], road, number[chosen])
    return Place(folder / "left" / "catalog.parquet", truth)


def town(name: str, data: Path, folder: Path, draw: int) -> Place:
    """Withhold cells of a town's DSM and DTM; truth is its DTM."""
    found = Town.unpacked(name, data, folder)
    transform = found.profile["transform"]
    columns, rows = np.meshgrid(np.arange(found.dtm.shape[1]), np.arange(found.dtm.shape[0]))
    x, y = (np.reshape(axis, rows.shape) for axis in transform * (columns + 0.5, rows + 0.5))
    number, out = squares(x, y, draw)
    left = (np.where(out, np.nan, heights) for heights in (found.dsm, found.dtm))
    found.catalog(*left).write(folder / "catalog.parquet")
    there = out & np.isfinite(found.dtm) & (found.cover != 4)
    truth = Truth(x[there], y[there], found.dtm[there], found.cover[there] == PAVED, number[there])
    return Place(folder / "catalog.parquet", truth)


def made(stratum: str, folder: Path, draw: int) -> Place:
    """Withhold points of a synthetic scan of two by two tiles, one for each draw; truth is its surface."""
    whole = Grid("EPSG:25832", 500000, 5600500, 1.0, 500, 500)
    options = SceneOptions(dsm_noise_m=(0.0, 0.0))
    scene = make_scene(whole, draw, stratum, options)
    points = scan(scene, per_m2=8, noise_m=0.03, seed=draw)
    left = rasterise(points[~squares(points.easting, points.northing, draw)[1]], whole, Options(), None)
    layers = {
        "dsm": left.dsm, "dtm": left.dtm, "road_height": left.top.height, "road_mask": scene.road_mask,
        "reference": scene.reference, "reference_road": scene.reference_road,
    }  # fmt: skip
    tiles = []
    for name, tile in whole.tiles(250):
        of_tile = {layer: values[whole.window(tile)] for layer, values in layers.items()}
        tiles.append(prepared.write_tile(folder, name, tile, of_tile))
    Catalog(tuple(prepared.with_neighbours(tiles))).write(folder / "catalog.parquet")
    x, y = np.meshgrid(whole.eastings, whole.northings)
    number, out = squares(x, y, draw)
    z, road = scene.reference, scene.reference_road
    return Place(folder / "catalog.parquet", Truth(x[out], y[out], z[out], road[out], number[out]))


def places(data: Path | None, roads: Path) -> dict[str, Maker]:
    """Return the places by name; each makes its data in a folder, for one draw of squares."""
    found: dict[str, Maker] = {
        f"made, {stratum}": lambda folder, draw, stratum=stratum: made(stratum, folder, draw)
        for stratum in ("urban", "suburban", "rural")
    }
    if data is None:
        return found
    drawn = data / "autzen" / "roads" / "autzen_north_roads.gpkg"
    autzen = ["--crs", "EPSG:2994", "--roads", f"{drawn}|layername=road_polygons"]
    autzen += ["--roads-where", "class = 'road' AND certainty <> 'low' AND visible_in IS NOT 'rgb'"]
    found["Autzen north"] = lambda folder, draw: scanned(
        [data / "autzen" / "autzen_north.laz"], autzen, folder, draw, FOOT_M
    )
    ign = sorted((data / "ign_crops" / "l93_770500_6277500").glob("*.la[sz]"))
    found["IGN"] = lambda folder, draw: scanned(
        ign, ["--roads", roads / "ign_l93.geojson", "--cell", 0.5], folder, draw
    )
    beach = ["--roads", roads / "brighton_beach.geojson", "--cell", 0.5, "--dop-cell", 0.25]
    found["Brighton Beach"] = lambda folder, draw: scanned(
        [data / "brighton_beach" / "model.laz"], beach, folder, draw
    )
    for name in ARCHIVES:
        found[name] = lambda folder, draw, name=name: town(name, data, folder, draw)
    return found


def run(place: Place, config: str, options: Sequence[str], folder: Path) -> flexroad.RunView:
    """Run a configuration over a place, FlexRoad alone."""
    file = folder.with_suffix(".yaml")
    file.write_text(f"extends: {config}\nvariants: {{flexroad: {{}}}}\n")
    chosen = [word for option in options for word in ("--set", option)]
    inputs = ["--config", file, *chosen, "--catalog", place.catalog]
    call("--allow", place.catalog.anchor, "run", *inputs, "--out", folder, "--executor", "serial").expected(0)
    return flexroad.open_run(folder, allow=[place.catalog.anchor])


def interval(values: Floats, groups: Floats, figure: Figure) -> tuple[float, float, float]:
    """Return a figure, a function of sums of values, and its interval by a bootstrap over groups."""
    _, index = np.unique(groups, return_inverse=True)
    sums = np.column_stack([np.bincount(index, value) for value in np.atleast_2d(values)])
    draws = np.random.default_rng(0).integers(0, len(sums), (DRAWS, len(sums)))
    low, high = np.percentile(figure(sums[draws].sum(axis=1).T), [2.5, 97.5])
    return float(figure(sums.sum(axis=0)[:, None])[0]), float(low), float(high)


def mean_of(values: Floats, groups: Floats) -> str:
    """Return the mean of values and its interval as text."""
    if not len(values):
        return "-"
    one = np.ones_like(values)
    mean, low, high = interval(np.stack([values, one]), groups, lambda sums: sums[0] / sums[1])
    return f"{mean:+.4f} ({low:+.4f} {high:+.4f})"


def rmse_of(errors: Floats, groups: Floats) -> str:
    rmse, low, high = interval(
        np.stack([errors**2, np.ones_like(errors)]), groups, lambda sums: np.sqrt(sums[0] / sums[1])
    )
    return f"{rmse:.4f} ({low:.4f} {high:.4f})"


def by_ground(truth: Truth, error: Floats) -> Iterator[tuple[str, Floats, Floats]]:
    """Yield a title, the errors that are known, and their squares, for road and terrain."""
    for ground, cells in (("road", truth.road), ("terrain", ~truth.road)):
        there = cells & np.isfinite(error)
        if there.any():
            yield f"  {ground}:", error[there], truth.square[there]


def estimates(folder: Path, place: Place) -> Floats:
    """Return the error estimate (m) of a run at what was withheld; NaN off the raw road mask."""
    truth = place.truth
    estimate = np.full(truth.x.shape, np.nan)
    for tile in select(str(folder), allow=[str(place.catalog.anchor)]).finished():
        west, south, east, north = tile.tile.grid.bounds
        inside = (truth.x >= west) & (truth.x < east) & (truth.y > south) & (truth.y <= north)
        error, _ = tile.level_errors(0)
        road = tile.road.mask[tile.road.grid.window(tile.road.core)]
        cells = tile.tile.grid.cells(truth.x[inside], truth.y[inside])
        estimate[inside] = np.where(road, error, np.nan)[cells]
    return estimate


def doubt(truth: Truth, error: Floats, estimate: Floats) -> str:
    """Return how well the error estimates of the road's squares agree with their errors, as text."""
    there = truth.road & np.isfinite(error + estimate)
    _, square, count = np.unique(truth.square[there], return_inverse=True, return_counts=True)
    off, expected = (np.bincount(square, values[there]) / count for values in (error, estimate))
    off, expected = np.abs(off[count >= FEWEST_IN_SQUARE]), expected[count >= FEWEST_IN_SQUARE]
    covered, worst = (off <= INTERVAL * expected).sum(), max(1, round(len(off) / 10))
    found = np.intersect1d(np.argsort(off)[-worst:], np.argsort(expected)[-worst:])
    means = f"mean error {off.mean():.4f}, mean estimate {expected.mean():.4f}"
    return f"{covered} of {len(off)} squares within the interval, {len(found)} of {worst} found, {means}"


def pooled(truths: Sequence[Truth]) -> Truth:
    """Return the truths of several draws as one; squares of different draws are different ones."""
    joined = {
        name: np.concatenate([getattr(truth, name) for truth in truths]) for name in ("x", "y", "z", "road")
    }
    numbers = [truth.square * len(truths) + k for k, truth in enumerate(truths)]
    return Truth(**joined, square=np.concatenate(numbers))


def compared(places: Sequence[Place], base: str, options: Sequence[str], folder: Path) -> Compared:
    """Run a configuration over the draws of a place and compare it with what was withheld."""
    errors, expected, mad, triangles = [], [], [], []
    for number, place in enumerate(places):
        out = folder / f"{folder.name}_{number}"
        view, truth = run(place, base, options, out), place.truth
        mad.append(view.metrics.mad_road_deg.to_numpy())
        triangles.append(view.metrics.triangles.to_numpy(np.float64))
        expected.append(estimates(out, place))
        errors.append(view.height(truth.x, truth.y) - truth.z)
    return Compared(*map(np.concatenate, (errors, expected, mad, triangles)))


def compare(name: str, places: Sequence[Place], folder: Path, configs: Configs) -> None:
    """Print the figures of each configuration, and what production changes."""
    truth = pooled([place.truth for place in places])
    results: dict[str, Compared] = {}
    for config, (base, options) in configs.items():
        (folder / config).mkdir()
        result = results[config] = compared(places, base, options, folder / config)
        number, seen = np.arange(len(result.mad)), np.isfinite(result.mad)
        mad, faces = mean_of(result.mad[seen], number[seen]), mean_of(result.triangles, number)
        print(f"{name}, {config}: MAD {mad} deg, T {faces}")
        for title, error, group in by_ground(truth, result.errors):
            l2, bias = mean_of(np.abs(error), group), mean_of(error, group)
            where = f"{error.size} in {np.unique(group).size} squares"
            print(f"{title} {where}: L2 {l2} RMSE {rmse_of(error, group)} bias {bias}", flush=True)
        print(f"  road: {doubt(truth, result.errors, result.estimates)}", flush=True)
    for other in (config for config in configs if config != "production"):
        gain = np.abs(results["production"].errors) - np.abs(results[other].errors)
        for title, change, group in by_ground(truth, gain):
            print(f"{title} L2 of production minus {other} {mean_of(change, group)}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("places", nargs="*", metavar="PLACE", help="names of places; all by default")
    parser.add_argument("--set", action="append", default=[], help="NAME=OPTION=VALUE of a configuration")
    parser.add_argument("--draw", type=int, default=FIRST, help="number of the first draw")
    chosen = parser.parse_args()
    configs: Configs = dict(CONFIGS)
    for text in chosen.set:
        name, _, option = text.partition("=")
        configs[name] = ("production", (*configs.get(name, ("", ()))[1], option))
    data = os.environ.get("FLEXROAD_REAL_DATA")
    there = places(Path(data) if data else None, Path(__file__).parents[1] / "tests" / "real" / "roads")
    for name in chosen.places or there:
        with tempfile.TemporaryDirectory() as scratch:
            folders = [Path(scratch) / f"draw {number}" for number in range(DRAWN.get(name, 1))]
            made_places = []
            for number, folder in enumerate(folders):
                folder.mkdir()
                made_places.append(there[name](folder, chosen.draw + number))
            compare(name, made_places, Path(scratch), configs)


if __name__ == "__main__":
    main()
