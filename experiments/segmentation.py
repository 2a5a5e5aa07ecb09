"""Compare road segmentation methods and two simple baselines around Autzen Stadium.

The western or the eastern half of the tiles is used for training and tuning; the other half is scored. The
truth is the roads drawn by hand; areas drawn with low certainty are ignored. Needs FLEXROAD_REAL_DATA, the
folder of real data. An argument is the path for a picture of the results.
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
from flexroad.pipeline.prepare.options import PrepareOptions
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
from flexroad.tasks.segment.pixels.features import features, read_tile_photo
from flexroad.tasks.segment.pixels.model import read_model
from flexroad.tasks.segment.training_types import Sample
from flexroad.tasks.types import Bools, Source, TileData

HALO_M = 60.0
MIDDLE_M = 194_250.0
"""Tiles east of this are the eastern half."""
BAND_M = 1.0
"""Cells this close to the edge of a label are not used for training, because the drawing is imprecise (m)."""
ABOVE_M, GREENNESS = np.arange(0.1, 1.05, 0.1), np.arange(-0.05, 0.125, 0.005)
WIDTHS_M = np.arange(4.0, 20.0, 0.5)
CLEANUP = Cleanup()
PICTURED = ("height and greenness", "pixels")
CERTAIN = "class = 'road' AND certainty <> 'low'"

Maps = list[Bools]
"""Road masks, one per tile."""


@dataclass(frozen=True, eq=False)
class Case:
    """A tile with its hand-drawn labels."""

    data: TileData
    road: Bools
    parking: Bools
    scored: Bools
    """Cells of the tile that are scored: inside the survey and drawn with certainty."""
    sample: Sample


def main() -> None:
    folder = os.environ.get("FLEXROAD_REAL_DATA")
    if not folder:
        print("set FLEXROAD_REAL_DATA to the folder of real data")
        return
    with tempfile.TemporaryDirectory() as scratch:
        cases = list(autzen(Path(folder) / "autzen", Path(scratch)))
        west = [case for case in cases if case.data.core.west < MIDDLE_M]
        east = [case for case in cases if case.data.core.west >= MIDDLE_M]
        pictured: dict[str, list[tuple[Case, Bools]]] = {method: [] for method in PICTURED}
        print(f"{'':38} {'IoU':>6} {'prec.':>6} {'recall':>6} {'without lots':>13}")
        for name, learn, score in (
            ("west, scored on east", west, east),
            ("east, scored on west", east, west),
        ):
            print(f"trained in the {name}")
            for method, method_function in methods(Path(scratch)).items():
                masks = method_function(learn, score)
                show(method, score, masks)
                if method in PICTURED:
                    pictured[method] += zip(score, masks, strict=True)
        if len(sys.argv) > 1:
            draw(Path(sys.argv[1]), pictured)


def autzen(home: Path, scratch: Path) -> Iterator[Case]:
    """Yield the tiles of the northern points; the orthophoto is the one registered to the heights."""
    made = prepare_points(
        [home / "autzen_north.laz"],
        scratch,
        PrepareOptions(crs="EPSG:2994"),
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
        options = rasterise.Options(
            layer="road_polygons", where=f"({where}) AND visible_in <> 'rgb'", left_out=()
        )
        return rasterise.rasterise_roads(data, options)

    road, uncertain = areas(CERTAIN), areas("certainty = 'low'")
    scored = np.zeros(data.grid.shape, bool)
    scored[data.grid.window(data.core)] = True
    scored &= ~beyond_extent(data) & (road | ~uncertain)
    trainable = scored & ~edge(road, BAND_M / data.grid.cell)
    return Case(data, road, areas("class = 'parking'"), scored, Sample(data, road, trainable))


def edge(mask: Bools, reach: float) -> Bools:
    from scipy.ndimage import distance_transform_edt as distance

    return (distance(mask) <= reach) & mask | (distance(~mask) <= reach) & ~mask


Method = Callable[[Sequence[Case], Sequence[Case]], Maps]


def methods(scratch: Path) -> dict[str, Method]:
    return {
        "height and greenness": height_and_green,
        "centre lines, one width": one_width,
        "centre lines, their own widths": lambda _, score: lines(score),
        "pixels, heights alone": lambda *halves: trained_pixels(*halves, scratch, photo=False),
        "pixels": lambda *halves: trained_pixels(*halves, scratch),
        "pixels, not tidied": lambda *halves: trained_pixels(*halves, scratch, cleanup=NOTHING),
    }


def height_and_green(learn: Sequence[Case], score: Sequence[Case]) -> Maps:
    """Segment cells that are low and not green; both thresholds are tuned on the training half."""

    def height_and_greenness(cases: Sequence[Case]) -> list[tuple[np.ndarray, np.ndarray]]:
        feature_maps = [features(case.data, read_tile_photo(case.data)) for case in cases]
        return [tuple(f.values[f.names.index(name)] for name in ("above", "greenness")) for f in feature_maps]

    train_values = height_and_greenness(learn)

    def low(cells, above, green) -> Maps:
        return [(height < above) & (tint < green) for height, tint in cells]

    best = max(product(ABOVE_M, GREENNESS), key=lambda pair: iou(*counts(learn, low(train_values, *pair))))
    return low(height_and_greenness(score), *best)


def lines(cases: Sequence[Case], width: float | None = None) -> Maps:
    widths = {} if width is None else {"width_columns": (), "class_columns": (), "default_width_m": width}
    options = vector.Options(layer="road_centerlines", where=CERTAIN, **widths)
    return [rasterise.rasterise_roads(case.data, options) for case in cases]


def one_width(learn: Sequence[Case], score: Sequence[Case]) -> Maps:
    return lines(score, max(WIDTHS_M, key=lambda width: iou(*counts(learn, lines(learn, width)))))


def trained_pixels(
    learn: Sequence[Case],
    score: Sequence[Case],
    scratch: Path,
    photo: bool | None = None,
    cleanup: Cleanup = CLEANUP,
) -> Maps:
    samples = [case.sample for case in learn]
    began = time.perf_counter()
    # The validation tiles affect only the history, so any tile can be used.
    made = training.train(samples, samples[:1], training.Options(photo=photo))
    trained = time.perf_counter()
    model = scratch / f"model{made.suffix}"
    model.write_bytes(made.model)
    about = read_model(model).about
    masks = [mask(case.data, segment.Options(model=model, cleanup=cleanup)) for case in score]
    ended = time.perf_counter()
    print(
        f"  {len(made.history)} rounds, {len(made.model) / 1e6:.1f} MB, threshold {about.threshold:.2f}, "
        f"expects IoU {about.trained['expected_iou']:.3f}; {trained - began:.0f} s to train, "
        f"{(ended - trained) / len(score):.2f} s a tile"
    )
    return masks


def mask(data: TileData, options: segment.Options) -> Bools:
    try:
        return segment.segment(data, options).mask
    except TaskError:
        return np.zeros(data.grid.shape, bool)


def counts(cases: Sequence[Case], masks: Maps, lots: bool = True) -> tuple[int, int, int]:
    """Return the numbers of true positives, of segmented cells and of road cells."""
    correct = segmented = road_cells = 0
    for case, mask in zip(cases, masks, strict=True):
        scored = case.scored if lots else case.scored & ~(case.parking & ~case.road)
        correct += int((mask & case.road & scored).sum())
        segmented += int((mask & scored).sum())
        road_cells += int((case.road & scored).sum())
    return correct, segmented, road_cells


def iou(correct: int, segmented: int, road_cells: int) -> float:
    return correct / (segmented + road_cells - correct)


def show(name: str, cases: Sequence[Case], masks: Maps) -> None:
    correct, segmented, road_cells = counts(cases, masks)
    without = iou(*counts(cases, masks, lots=False))
    precision, recall = correct / segmented, correct / road_cells
    print(
        f"{name:38} {iou(correct, segmented, road_cells):6.3f} {precision:6.3f} {recall:6.3f} {without:13.3f}"
    )


def draw(path: Path, pictured: dict[str, list[tuple[Case, Bools]]]) -> None:
    """Draw each method's masks over the photo: true positives green, false positives red, misses blue."""
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
        axis.set_title(f"{method}; each half segmented with training on the other")
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
