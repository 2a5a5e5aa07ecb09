"""``flexroad prepare``: DSM, DTM, bridge decks and orthophoto from point clouds."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from datetime import UTC, datetime, time
from pathlib import Path
from typing import Literal

import numpy as np

from flexroad.catalog import CatalogError
from flexroad.catalog.crs import short
from flexroad.catalog.scan.point_clouds import Cloud, find, inspect
from flexroad.catalog.text import some
from flexroad.catalog.to_metres import MetricTransform, agreed
from flexroad.pipeline.execute import Executor
from flexroad.tools.prepare.blockwise import write_blocks
from flexroad.tools.prepare.options import PrepareOptions, check_disk, prepared_grid, written
from flexroad.tools.prepare.output import scratch_folder
from flexroad.tools.prepare.point_buckets import RECORD, block_edge_of
from flexroad.tools.prepare.point_reading import BucketedPoints, bucket_points
from flexroad.tools.prepare.points.to_rasters import BRIDGE_CLASSES, Options, points_reach_m, tags
from flexroad.tools.prepare.raster_writer import PreparedDataset, RasterWriter
from flexroad.tools.prepare.roads import add_roads, check_roads

Ground = Literal["auto", "classes", "filter", "morphological"]
MIN_GROUND = 0.01
"""A file with a smaller share of ground points is treated as not classified."""
DENSE, DENSE_CONFIDENCE = 50.0, 3.0
"""Above this density (points per m2) the slope filter uses this ``confidence``."""
FEWER = "prepare fewer files at a time"
LARGE, GAP_M = 10**9, 10_000.0
"""In areas with at least this many cells, an empty gap of this width (m) and half the side is an error."""


def prepare_points(
    files: Sequence[Path],
    out: Path,
    common: PrepareOptions,
    options: Options,
    executor: Executor,
    log: Callable[[str], None],
    ground: Ground = "auto",
) -> PreparedDataset:
    """Make the rasters and the catalog of an area from point clouds.

    Every file is decoded once. A worker has one chunk of a file or one block in memory, so memory does not
    depend on the size of the files and the area. Temporary files take 16 bytes per point.

    - `files`: LAS, LAZ or COPC files, and folders of them.
    - `options`: how points become rasters; its ``ground`` is replaced by the parameter.
    - `ground`: how ground points are identified: ``classes``, ``filter``, ``morphological`` or ``auto``.
      ``auto`` uses classes if in every file at least `MIN_GROUND` of the points, but not all, are ground.
    """
    check_roads(common)
    step = common.step_m
    clouds = tuple(inspect(path) for path in find(files))
    frame = _frame(clouds, common)
    names = some([str(cloud.path) for cloud in clouds])
    check_disk(out, RECORD.itemsize * sum(cloud.points for cloud in clouds), f"the points of {names}", FEWER)
    with scratch_folder(out) as folder, executor.held() as held:
        possible = ("classes", "filter") if ground == "auto" else (ground,)
        farthest = max(points_reach_m(_with_method(options, method), common.cell_m) for method in possible)
        edge = block_edge_of(clouds, frame, farthest, step)
        bucketed = bucket_points(clouds, frame, folder, edge, held, log)
        method, notes = _ground(clouds, bucketed, options, ground)
        options, dense = _for_density(_with_method(options, method), bucketed)
        colourless = [
            cloud.path.name
            for cloud, coloured in zip(clouds, bucketed.has_colours, strict=True)
            if not coloured
        ]
        _require_no_gap(clouds, frame, bucketed, common.cell_m)
        grid = prepared_grid(bucketed.bounds, frame.target, common, names, out, photo=not colourless)
        common, dated = _dated(common, clouds, bucketed)
        notes = (*frame.notes, *notes, *dense, *dated, *_other_bridges(bucketed, options))
        notes += _left_out(bucketed, colourless)
        file_tags = _tags(clouds, frame, bucketed, options)
        dop_cell = None if colourless else common.dop_cell_m
        with RasterWriter(out, grid, dop_cell, file_tags, frame.vertical) as writer:
            write_blocks(writer, bucketed, options, held, log)
            add_roads(writer, common)
            dataset = common.dataset or _name(files)
            published = writer.publish(
                common.tile_size_m, common.date, dataset, common.min_cover, common.assumed_date, held
            )
            return published.with_notes(*notes)


def _dated(
    common: PrepareOptions, clouds: Sequence[Cloud], bucketed: BucketedPoints
) -> tuple[PrepareOptions, tuple[str, ...]]:
    """Return the options with the date of the survey, and a note on its source.

    It is the date of the first point, by GPS time; else the date of the latest file, which is only assumed.
    """
    if common.date is not None:
        return common, ()
    if bucketed.dates:
        first, last = (f"{date:%Y-%m-%d}" for date in bucketed.dates)
        span = first if first == last else f"{first} to {last}"
        return replace(common, date=bucketed.dates[0]), (f"date of the survey: {span}, by GPS time",)
    created = [cloud.created for cloud in clouds if cloud.created]
    header = datetime.combine(max(created), time(), UTC) if created else None
    return replace(common, assumed_date=header or written(cloud.path for cloud in clouds)), ()


def _frame(clouds: Sequence[Cloud], common: PrepareOptions) -> MetricTransform:
    crs = agreed([(str(cloud.path), cloud.crs) for cloud in clouds], common.crs)
    west, south, east, north = clouds[0].bounds
    return MetricTransform.of(
        crs, ((west + east) / 2, (south + north) / 2), common.to_crs, common.height_unit
    )


def _with_method(options: Options, method: str) -> Options:
    return options.model_copy(update={"ground": method})


def _ground(
    clouds: Sequence[Cloud], bucketed: BucketedPoints, options: Options, requested: Ground
) -> tuple[str, tuple[str, ...]]:
    """Return how ground points are identified, and a note with the reason if this is unexpected."""
    classes = list(options.ground_classes)
    share = [kinds[classes].sum() / max(1, kinds.sum()) for kinds in bucketed.kinds]
    class_names = _classes(classes)
    if requested in ("filter", "morphological"):
        return requested, ()
    if requested == "classes":
        if not any(share):
            raise CatalogError(
                f"no point of {class_names} in {some([str(cloud.path) for cloud in clouds])}; "
                "leave --ground classes out, or give the ground classes with --ground-class"
            )
        return "classes", ()
    one_class = [
        c.path.name for c, kinds in zip(clouds, bucketed.kinds, strict=True) if (kinds > 0).sum() == 1
    ]
    if one_class:
        return "filter", (
            f"all points of {some(one_class)} have the same class: ground is identified by the slope filter",
        )
    unclassified = [c.path.name for c, ground in zip(clouds, share, strict=True) if ground < MIN_GROUND]
    if unclassified:
        few = f"less than {MIN_GROUND:.0%} of the points of {some(unclassified)} are ground ({class_names})"
        return "filter", (
            f"{few}: ground is identified by the slope filter; use --ground classes to use the classes",
        )
    return "classes", ()


def _for_density(options: Options, bucketed: BucketedPoints) -> tuple[Options, tuple[str, ...]]:
    """Return the options for the density of the points, and a note if they were changed.

    A dense cloud has so many pairs of neighbours that noise alone lets some exceed the usual tolerance.
    """
    west, south, east, north = bucketed.bounds
    area = min((east - west) * (north - south), len(bucketed.occupied) * bucketed.buckets.edge**2)
    density = bucketed.points / max(area, 1)
    is_given = "confidence" in options.filter.model_fields_set
    if options.ground != "filter" or density <= DENSE or is_given:
        return options, ()
    tolerant = options.filter.model_copy(update={"confidence": DENSE_CONFIDENCE})
    note = f"{density:.0f} points per m2: the slope filter uses confidence {DENSE_CONFIDENCE:g}"
    return options.model_copy(update={"filter": tolerant}), (note,)


def _classes(classes: Collection[int]) -> str:
    return "class " + ", ".join(map(str, classes))


def _other_bridges(bucketed: BucketedPoints, options: Options) -> tuple[str, ...]:
    """Return notes on points of classes that mean bridges in another scheme."""
    meanings = {
        "asprs": "bridge decks by the standard of LAS, are not used; --bridge-class",
        "ahn": "bridges and other structures in the Dutch AHN, are not used as bridges; --bridge-class",
    }
    notes = []
    for scheme, meaning in meanings.items():
        (number,) = BRIDGE_CLASSES[scheme]
        points = int(sum(kinds[number] for kinds in bucketed.kinds))
        if points and number not in {*options.bridge_classes, *options.ground_classes}:
            notes.append(f"{points:,} points of class {number}, {meaning} {number} takes them")
    return tuple(notes)


def _left_out(bucketed: BucketedPoints, colourless: Sequence[str]) -> tuple[str, ...]:
    """Return notes on data that the rasters do not contain."""
    notes = []
    if bucketed.out_of_range:
        notes.append(
            f"left out {bucketed.out_of_range:,} points with heights outside -500..9000 m; "
            "check --height-unit"
        )
    if colourless:
        notes.append(f"no orthophoto: no colours in {some(colourless)}")
    return tuple(notes)


def _require_no_gap(
    clouds: Sequence[Cloud], frame: MetricTransform, bucketed: BucketedPoints, cell_m: float
) -> None:
    """Raise an error if an area is large only because of a few distant points."""
    west, south, east, north = bucketed.bounds
    if (east - west) * (north - south) <= LARGE * cell_m**2:
        return
    buckets = bucketed.buckets
    for axis, side in ((0, east - west), (1, north - south)):
        lines = np.unique([index[axis] for index in bucketed.occupied])
        gap = np.diff(lines, append=lines[-1])
        widest = int(gap.argmax())
        width = (gap[widest] - 1) * buckets.edge
        if width < max(GAP_M, side / 2):
            continue
        first = [index for index in bucketed.occupied if index[axis] <= lines[widest]]
        last = bucketed.occupied.difference(first)
        few = min(first, last, key=lambda blocks: sum(map(buckets.count, blocks)))
        x, y = buckets.first_point(min(few))
        raise CatalogError(
            f"{_file_at(clouds, frame, x, y)} has points at easting {x:.2f} and northing {y:.2f} (m), "
            f"{width / 1000:.0f} km from the others; remove points with wrong coordinates, prepare distant "
            "files separately, or use larger cells (--cell)"
        )


def _file_at(clouds: Sequence[Cloud], frame: MetricTransform, x: float, y: float) -> Path:
    """Return the file whose bounds are nearest to a point (m)."""

    def distance(cloud: Cloud) -> float:
        west, south, east, north = cloud.bounds
        xs, ys, _ = frame.metres(np.array([west, east]), np.array([south, north]), np.zeros(2))
        return float(max(min(xs) - x, x - max(xs), min(ys) - y, y - max(ys)))

    return min(clouds, key=distance).path


def _tags(
    clouds: Sequence[Cloud], frame: MetricTransform, bucketed: BucketedPoints, options: Options
) -> dict[str, str]:
    """Return the TIFF tags with the source and the processing of the rasters."""
    return {
        "SOURCE": some([cloud.path.name for cloud in clouds]),
        "SOURCE_CREATED": some(sorted({str(cloud.created) for cloud in clouds if cloud.created}))
        or "unknown",
        "POINTS": str(bucketed.points),
        "SOURCE_CRS": short(frame.source),
        "SOURCE_UNITS": f"{frame.plan_m or 'reprojected'} m in plan, {frame.height_m} m in height",
        **tags(options),
        "LEFT_OUT": "noise (classes 7, 18) and withheld points",
    }


def _name(files: Sequence[Path]) -> str:
    """Return the name of the data in reports: the name of the only file, or of the first file's folder."""
    first = files[0].resolve()
    return first.name.split(".")[0] if len(files) == 1 else first.parent.name
