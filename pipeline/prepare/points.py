"""``flexroad prepare points``: surface, ground, bridges and orthophoto from point clouds."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from pathlib import Path
from typing import Literal

from flexroad.catalog import CatalogError
from flexroad.catalog.crs import short
from flexroad.catalog.headers.point_clouds import Cloud, find, inspect
from flexroad.catalog.headers.rasters import some
from flexroad.catalog.to_metres import MetricTransform, agreed
from flexroad.pipeline.execute import Executor
from flexroad.pipeline.prepare.asked import Asked
from flexroad.pipeline.prepare.blocks import fill, sheet_grid
from flexroad.pipeline.prepare.roads import add_roads
from flexroad.pipeline.prepare.sheet import Published, Sheet
from flexroad.pipeline.prepare.spool import Spooled, edge_m, scratch, spool
from flexroad.tasks.acquire.points.to_rasters import Options, facts, reach_m

Ground = Literal["auto", "classes", "filter"]
MIN_GROUND = 0.01
"""A file with a smaller share of ground among its points counts as not classified."""
DENSE, DENSE_CONFIDENCE = 50.0, 3.0
"""Points per m2 from where on the slope filter has to be surer, and how sure: docs/ground.md."""
MAX_CELLS = 10**10
"""100 km x 100 km at 1 m: a larger sheet means that a point lies astray."""


def prepare_points(
    files: Sequence[Path],
    out: Path,
    asked: Asked,
    options: Options,
    executor: Executor,
    say: Callable[[str], None],
    ground: Ground = "auto",
) -> Published:
    """Make the rasters and the catalog of an area from point clouds.

    Every file is decoded once. Memory holds one chunk of a file, or one block per worker: it grows neither
    with the files nor with the area. The disk holds 16 bytes per point meanwhile.

    Parameters
    ----------
    files : Sequence[Path]
        LAS, LAZ or COPC files, and folders of them.
    out : Path
        Folder to publish in.
    asked : Asked
        What all commands share.
    options : Options
        How points become rasters; its ``ground`` gives way to the parameter.
    executor : Executor
        Makes the blocks.
    say : Callable[[str], None]
        Told what is being done, a line each.
    ground : str
        What finds the ground: ``classes``, ``filter``, or ``auto``: classes if in every file at least
        `MIN_GROUND` of the points, but not all points, are of a ground class.

    Raises
    ------
    CatalogError
        If a file is missing, unreadable, empty or cut short, the files' CRSs differ or are unknown, or
        classes were asked for that no point has.
    ConfigError
        If the folder cannot be written, the disk is full, or cells and pixels do not fit.
    """
    step = asked.step_m
    clouds = tuple(inspect(path) for path in find(files))
    frame = _frame(clouds, asked)
    with scratch(out) as folder:
        farthest = max(reach_m(_with(options, method), asked.cell_m) for method in ("classes", "filter"))
        spooled = spool(clouds, frame, folder, edge_m(clouds, frame, farthest, step), say)
        method, notes = _ground(clouds, spooled, options, ground)
        options, dense = _for_density(_with(options, method), spooled)
        grid = sheet_grid(spooled.bounds, frame.target, asked.cell_m, step)
        if grid.width * grid.height > MAX_CELLS:
            raise CatalogError(_astray(clouds))
        black = [cloud.path.name for cloud, seen in zip(clouds, spooled.colours, strict=True) if not seen]
        notes = (*frame.notes, *notes, *dense, *_left_out(spooled, black))
        tags = _tags(clouds, frame, spooled, options)
        with Sheet(out, grid, None if black else asked.dop_cell_m, tags) as sheet:
            fill(sheet, spooled, options, executor, say)
            add_roads(sheet, asked)
            dataset = asked.dataset or _name(files)
            return sheet.publish(asked.tile_size_m, asked.date, dataset).noting(*notes)


def _frame(clouds: Sequence[Cloud], asked: Asked) -> MetricTransform:
    crs = agreed([(str(cloud.path), cloud.crs) for cloud in clouds], asked.crs)
    west, south, east, north = clouds[0].bounds
    return MetricTransform.of(crs, ((west + east) / 2, (south + north) / 2), asked.to_crs, asked.height_unit)


def _with(options: Options, method: str) -> Options:
    return options.model_copy(update={"ground": method})


def _ground(
    clouds: Sequence[Cloud], spooled: Spooled, options: Options, asked: Ground
) -> tuple[str, tuple[str, ...]]:
    """Return what finds the ground, and why if that was not to be expected."""
    classes = list(options.ground_classes)
    share = [kinds[classes].sum() / max(1, kinds.sum()) for kinds in spooled.kinds]
    named = _classes(classes)
    if asked == "filter":
        return "filter", ()
    if asked == "classes":
        if not any(share):
            raise CatalogError(
                f"no point of {named} in {some([str(cloud.path) for cloud in clouds])}; "
                "leave --ground classes out, or name the ground with --ground-class"
            )
        return "classes", ()
    alike = [c.path.name for c, kinds in zip(clouds, spooled.kinds, strict=True) if (kinds > 0).sum() == 1]
    if alike:
        return "filter", (f"all points of {some(alike)} are of one class: the slope filter finds the ground",)
    bare = [c.path.name for c, ground in zip(clouds, share, strict=True) if ground < MIN_GROUND]
    if bare:
        few = f"less than {MIN_GROUND:.0%} of the points of {some(bare)} are ground ({named})"
        return "filter", (f"{few}: the slope filter finds the ground; --ground classes takes the classes",)
    return "classes", ()


def _for_density(options: Options, spooled: Spooled) -> tuple[Options, tuple[str, ...]]:
    """Return the options for so many points per m2: of very many near by, one lies low by noise alone."""
    west, south, east, north = spooled.bounds
    area = min((east - west) * (north - south), len(spooled.places) * spooled.blocks.edge**2)
    density = spooled.points / max(area, 1)
    told = "confidence" in options.filter.model_fields_set
    if options.ground != "filter" or density <= DENSE or told:
        return options, ()
    surer = options.filter.model_copy(update={"confidence": DENSE_CONFIDENCE})
    note = f"{density:.0f} points per m2: the slope filter allows for {DENSE_CONFIDENCE:g} times their noise"
    return options.model_copy(update={"filter": surer}), (note,)


def _classes(classes: Collection[int]) -> str:
    return "class " + ", ".join(map(str, classes))


def _left_out(spooled: Spooled, black: Sequence[str]) -> tuple[str, ...]:
    """Return notes on what did not become part of the rasters."""
    notes = []
    if spooled.beyond:
        notes.append(
            f"left out {spooled.beyond:,} points with heights beyond -500..9000 m; is --height-unit right?"
        )
    if black:
        notes.append(f"no orthophoto: no colours in {some(black)}")
    return tuple(notes)


def _astray(clouds: Sequence[Cloud]) -> str:
    def size(cloud: Cloud) -> float:
        west, south, east, north = cloud.bounds
        return max(east - west, north - south)

    widest = max(clouds, key=size)
    return (
        f"the points lie too far apart for one area; {widest.path} alone spans {size(widest):.0f} of its "
        "units: cut off what lies astray, prepare distant files apart, or take larger cells (--cell)"
    )


def _tags(
    clouds: Sequence[Cloud], frame: MetricTransform, spooled: Spooled, options: Options
) -> dict[str, str]:
    """Return the tags that tell how the rasters were made."""
    return {
        "SOURCE": some([cloud.path.name for cloud in clouds]),
        "SOURCE_CREATED": some(sorted({str(cloud.created) for cloud in clouds if cloud.created}))
        or "unknown",
        "POINTS": str(spooled.points),
        "SOURCE_CRS": short(frame.source),
        "SOURCE_UNITS": f"{frame.plan_m or 'reprojected'} m in plan, {frame.height_m} m in height",
        **facts(options),
        "LEFT_OUT": "noise (classes 7, 18) and withheld points",
    }


def _name(files: Sequence[Path]) -> str:
    """Return what reports call the data: the folder, or the only file."""
    first = files[0].resolve()
    return first.name.split(".")[0] if len(files) == 1 else first.parent.name
