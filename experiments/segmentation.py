"""Roads found by each method around Autzen Stadium, beside two plain baselines.

Half of the tiles, those in the west or those in the east, is there to learn and to tune on; the other half
is scored. Truth are the roads drawn by hand; areas drawn with little certainty do not count. Needs the
folder named by FLEXROAD_REAL_DATA. With a file name
as argument, a picture of what was found goes there.
"""

from __future__ import annotations

import os
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

import numpy as np

from flexroad.catalog import Catalog
from flexroad.pipeline.execute import SerialExecutor
from flexroad.pipeline.prepare.asked import Asked
from flexroad.pipeline.prepare.points import prepare_points
from flexroad.tasks import load
from flexroad.tasks.acquire.points import to_rasters
from flexroad.tasks.errors import TaskError
from flexroad.tasks.io.orthophoto import read_photo
from flexroad.tasks.roads import rasterise
from flexroad.tasks.roads.extent import beyond_extent
from flexroad.tasks.roads.mask_cleanup import NOTHING, Cleanup
from flexroad.tasks.segment import vector
from flexroad.tasks.segment.pixels import segment
from flexroad.tasks.segment.pixels import train as training
from flexroad.tasks.segment.pixels.features import features, look
from flexroad.tasks.segment.pixels.model import read_model
from flexroad.tasks.segment.training_types import Sample
from flexroad.tasks.types import Bools, Source, TileData

HALO_M = 60.0
MIDDLE_M = 194_250.0
"""Tiles east of this are the eastern half."""
BAND_M = 1.0
"""Cells this near to the edge of a label are not learnt: the drawing is no better. All are scored."""
ABOVE_M, GREENNESS = np.arange(0.1, 1.05, 0.1), np.arange(-0.05, 0.125, 0.005)
WIDTHS_M = np.arange(4.0, 20.0, 0.5)
TIDY = Cleanup()
SHOWN = ("height and greenness", "pixels")
SURE = "class = 'road' AND certainty <> 'low'"

Maps = list[Bools]
"""What was found on each of some tiles."""


@dataclass(frozen=True, eq=False)
class Case:
    """A tile with what is drawn on it."""

    data: TileData
    road: Bools
    parking: Bools
    scored: Bools
    """Cells of the tile inside the survey, without what is uncertain."""
    sample: Sample


def main() -> None:
    folder = os.environ.get("FLEXROAD_REAL_DATA")
    if not folder:
        print("FLEXROAD_REAL_DATA is not set: nothing to score on")
        return
    with tempfile.TemporaryDirectory() as scratch:
        cases = list(autzen(Path(folder) / "autzen", Path(scratch)))
        west = [case for case in cases if case.data.core.west < MIDDLE_M]
        east = [case for case in cases if case.data.core.west >= MIDDLE_M]
        pictured: dict[str, list[tuple[Case, Bools]]] = {method: [] for method in SHOWN}
        print(f"{'':38} {'IoU':>6} {'prec.':>6} {'recall':>6} {'without lots':>13}")
        for name, learn, score in (
            ("west, scored on east", west, east),
            ("east, scored on west", east, west),
        ):
            print(f"learnt in the {name}")
            for method, find in methods(Path(scratch)).items():
                found = find(learn, score)
                show(method, score, found)
                if method in SHOWN:
                    pictured[method] += zip(score, found, strict=True)
        if len(sys.argv) > 1:
            draw(Path(sys.argv[1]), pictured)


def autzen(home: Path, scratch: Path) -> Iterator[Case]:
    """Make the catalog of the northern points; its colours come from the photo moved onto the heights."""
    made = prepare_points(
        [home / "autzen_north.laz"],
        scratch,
        Asked(crs="EPSG:2994"),
        to_rasters.Options(),
        SerialExecutor(),
        lambda _: None,
    )
    photo = Source("dop", (home / "autzen_dop_north_0p5m_reg.tif",))
    drawn = Source("roads", (home / "roads" / "autzen_north_roads.gpkg",))
    for tile in Catalog.read(made.catalog).tiles:
        yield case(replace(load.load(tile, load.Options(halo_m=HALO_M)), dop=photo, roads=drawn))


def case(data: TileData) -> Case:
    def areas(where: str) -> Bools:
        asked = rasterise.Options(
            layer="road_polygons", where=f"({where}) AND visible_in <> 'rgb'", left_out=()
        )
        return rasterise.rasterise_roads(data, asked)

    road, unsure = areas(SURE), areas("certainty = 'low'")
    scored = np.zeros(data.grid.shape, bool)
    scored[data.grid.window(data.core)] = True
    scored &= ~beyond_extent(data) & (road | ~unsure)
    known = scored & ~edge(road, BAND_M / data.grid.cell)
    return Case(data, road, areas("class = 'parking'"), scored, Sample(data, road, known))


def edge(mask: Bools, reach: float) -> Bools:
    from scipy.ndimage import distance_transform_edt as distance

    return (distance(mask) <= reach) & mask | (distance(~mask) <= reach) & ~mask


Method = Callable[[Sequence[Case], Sequence[Case]], Maps]


def methods(scratch: Path) -> dict[str, Method]:
    return {
        "height and greenness": plain,
        "centre lines, one width": one_width,
        "centre lines, their own widths": lambda _, score: lines(score),
        "pixels, heights alone": lambda *halves: learnt(*halves, scratch, photo=False),
        "pixels": lambda *halves: learnt(*halves, scratch),
        "pixels, not tidied": lambda *halves: learnt(*halves, scratch, cleanup=NOTHING),
    }


def plain(learn: Sequence[Case], score: Sequence[Case]) -> Maps:
    """Cells that are low and not green; both thresholds are the best of the half to learn on."""

    def seen(cases: Sequence[Case]) -> list[tuple[np.ndarray, np.ndarray]]:
        found = [features(case.data, look(case.data)) for case in cases]
        return [tuple(f.values[f.names.index(name)] for name in ("above", "greenness")) for f in found]

    there = seen(learn)

    def low(cells, above, green) -> Maps:
        return [(height < above) & (tint < green) for height, tint in cells]

    best = max(product(ABOVE_M, GREENNESS), key=lambda pair: iou(*counts(learn, low(there, *pair))))
    return low(seen(score), *best)


def lines(cases: Sequence[Case], width: float | None = None) -> Maps:
    one = {} if width is None else {"width_columns": (), "class_columns": (), "default_width_m": width}
    options = vector.Options(layer="road_centerlines", where=SURE, **one)
    return [rasterise.rasterise_roads(case.data, options) for case in cases]


def one_width(learn: Sequence[Case], score: Sequence[Case]) -> Maps:
    return lines(score, max(WIDTHS_M, key=lambda width: iou(*counts(learn, lines(learn, width)))))


def learnt(
    learn: Sequence[Case],
    score: Sequence[Case],
    scratch: Path,
    photo: bool | None = None,
    cleanup: Cleanup = TIDY,
) -> Maps:
    samples = [case.sample for case in learn]
    began = time.perf_counter()
    # Nothing but the history hangs on the validation tiles: any will do.
    made = training.train(samples, samples[:1], training.Options(photo=photo))
    trained = time.perf_counter()
    model = scratch / f"model{made.suffix}"
    model.write_bytes(made.model)
    about = read_model(model).about
    found = [mask(case.data, segment.Options(model=model, cleanup=cleanup)) for case in score]
    ended = time.perf_counter()
    print(
        f"  {len(made.history)} rounds, {len(made.model) / 1e6:.1f} MB, threshold {about.threshold:.2f}, "
        f"expects IoU {about.trained['expected_iou']:.3f}; {trained - began:.0f} s to train, "
        f"{(ended - trained) / len(score):.2f} s a tile"
    )
    return found


def mask(data: TileData, options: segment.Options) -> Bools:
    try:
        return segment.segment(data, options).mask
    except TaskError:
        return np.zeros(data.grid.shape, bool)


def counts(cases: Sequence[Case], found: Maps, lots: bool = True) -> tuple[int, int, int]:
    """Return how many cells are road and found, found, and road."""
    hit = called = there = 0
    for case, mask in zip(cases, found, strict=True):
        scored = case.scored if lots else case.scored & ~(case.parking & ~case.road)
        hit += int((mask & case.road & scored).sum())
        called += int((mask & scored).sum())
        there += int((case.road & scored).sum())
    return hit, called, there


def iou(hit: int, called: int, there: int) -> float:
    return hit / (called + there - hit)


def show(name: str, cases: Sequence[Case], found: Maps) -> None:
    hit, called, there = counts(cases, found)
    without = iou(*counts(cases, found, lots=False))
    print(f"{name:38} {iou(hit, called, there):6.3f} {hit / called:6.3f} {hit / there:6.3f} {without:13.3f}")


def draw(path: Path, pictured: dict[str, list[tuple[Case, Bools]]]) -> None:
    """Draw each method's finds over the photo: hits green, false alarms red, misses blue."""
    import matplotlib.pyplot as plt
    from PIL import Image

    figure, axes = plt.subplots(len(pictured), 1, figsize=(9, 5.7 * len(pictured)), layout="constrained")
    for axis, (method, pairs) in zip(axes, pictured.items(), strict=True):
        cores = [case.data.core for case, _ in pairs]
        west, north = min(core.west for core in cores), max(core.north for core in cores)
        size = tuple(
            int(edge) for edge in (north - min(c.south for c in cores), max(c.east for c in cores) - west)
        )
        canvas = np.full((*size, 3), 255, np.uint8)
        for case, mask in pairs:
            core = case.data.core
            row, col = round(north - core.north), round(core.west - west)
            canvas[row : row + core.height, col : col + core.width] = coloured(case, mask)
        axis.imshow(canvas[(canvas < 255).any(axis=(1, 2))])
        axis.axvline(MIDDLE_M - west, color="white", linewidth=1)
        axis.set_title(f"{method}; each half by what the other taught")
        axis.set_axis_off()
    figure.savefig(path, dpi=80)
    with Image.open(path) as picture:
        picture.convert("RGB").quantize(96).save(path, optimize=True)


def coloured(case: Case, mask: Bools) -> np.ndarray:
    data = case.data
    photo = read_photo(data.dop, data.core, data.core.cell)
    core = data.grid.window(data.core)
    mask, road, scored = mask[core], case.road[core], case.scored[core]
    picture = 80 + photo.colour.transpose(1, 2, 0) // 2
    for where, colour in (
        (mask & road, (40, 170, 60)),
        (mask & ~road, (220, 50, 40)),
        (~mask & road, (40, 90, 230)),
    ):
        picture[where & scored] = colour
    picture[~photo.known] = 255
    return picture


if __name__ == "__main__":
    main()
