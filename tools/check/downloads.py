"""The kinds of files in a folder of downloads, and the commands that make a catalog of them."""

from __future__ import annotations

import glob
import os
import re
import shlex
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from flexroad.catalog import layouts
from flexroad.catalog.crs import in_plan, plan_unit, short
from flexroad.catalog.errors import CatalogError
from flexroad.catalog.guard.open_raster import ERRORS, open_raster
from flexroad.catalog.scan.inputs import MESHES, POINTS, is_project
from flexroad.catalog.scan.point_clouds import inspect
from flexroad.catalog.scan.rasters import quiet, read_valid
from flexroad.catalog.scan.vectors import layers as layers_of
from flexroad.catalog.scan.vectors import listed
from flexroad.catalog.sources import nrw
from flexroad.catalog.text import count

MAX_FILES = 5000
"""Largest number of files that are read."""
GEROD_ZIP = r"gerod.*\.zip"
"""Name of the archive of the paper's dataset."""
MAX_DEPTH = 8
"""Largest depth of folders below the given folder."""
PREVIEW = 256
"""Side of the reduced raster from which the range of values is read (cells)."""
RUN_FILE = "run.json"
"""Name of the file in a run's folder: a copy of `record.RECORD`, because that module is slow to import."""
FEW_VALUES = 40
"""Largest number of distinct values of a mask or land cover."""

SUFFIXES = {
    "raster": (".tif", ".tiff", ".asc", ".xyz", ".txt", ".gz", ".vrt", ".jp2"),
    "cloud": POINTS,
    "vector": (".gpkg", ".sqlite", ".shp", ".geojson", ".fgb", ".osm", ".pbf"),
    "mesh": MESHES,
    "photo": (".jpg", ".jpeg"),
    "archive": (".zip", ".7z", ".tar", ".tgz", ".rar"),
}
"""Kind -> endings of its files. The layer of a raster then follows from its name."""
ROADS = r"road|street|stra(ss|ß)e|highway|carriage|route|centre.?line|center.?line|osm"
"""Words in names of vector files and their layers that mean roads."""
QUESTIONS = {
    "above_ground": "heights above the ground are no surface model; which file has the heights of surface?",
    "raster": "is it a DSM (--dsm), a DTM (--dtm), an orthophoto (--dop) or a road mask (--road-mask)?",
    "archive": "unpack it first",
}
"""Kind of a file that no command accepts -> what the user must decide or do."""
NO_CRS = "it has no CRS: which is it (--crs)?"


LAYERS = ("dsm", "dtm", "road_height", "dop", "road_mask")
"""Layers with rasters."""
LAYER = "|layername=NAME to --roads, in quotes, with the layer of the roads"
"""What to add for a vector file of several layers."""


@dataclass(frozen=True)
class Download:
    """One file and its probable kind."""

    path: Path
    kind: str
    """A layer of the catalog, or a key of `SUFFIXES` or `QUESTIONS`."""
    about: str = ""
    """Bands, type, range of values, CRS, if the kind has them."""
    crs: str | None = None
    """For rasters and clouds: the short name of their CRS; None without a CRS."""
    question: str = ""
    """What the user must decide; may be empty."""
    metric: bool = True
    """False for a raster whose CRS is in feet or degrees."""


@dataclass(frozen=True)
class Proposal:
    """A command that makes a catalog, and its missing parts."""

    command: str
    catalog: Path
    """The catalog that it makes."""
    roads: str = ""
    """The layer of roads that the catalog will have; empty if unknown."""
    open: str = ""
    """What the user must add to the command; may be empty."""


def look(folder: Path) -> tuple[list[Download], bool]:
    """Return the downloads below a folder, by path, and whether the folder has more files than were read."""
    if not folder.is_dir():
        raise CatalogError(f"folder {folder} does not exist; name the folder of the downloads")
    kinds = {suffix: kind for kind, suffixes in SUFFIXES.items() for suffix in suffixes}
    found: list[Download] = []
    for number, path in enumerate(_files(folder)):
        if number == MAX_FILES:
            return found, True
        kind = kinds.get(path.suffix.lower())
        if kind == "raster":
            found += _raster(path, folder)
        elif kind == "cloud":
            found.append(_cloud(path))
        elif kind == "vector":
            found.append(_vectors(path))
        elif kind:
            found.append(Download(path, kind, question=QUESTIONS.get(kind, "")))
    return found, False


def gerod(folder: Path) -> list[str]:
    """Return the present and the missing parts of the paper's dataset, and the command for its catalog.

    Empty if the folder has no tile that the paper names, and no archive of the dataset.
    """
    archives = [path for path in sorted(folder.glob("*")) if re.fullmatch(GEROD_ZIP, path.name.lower())]
    found, _ = layouts.find(folder)
    if not {file.tile for file in found} & {*layouts.NAMED}:
        commands = [_gerod_command(path) for path in archives if path.is_file()]
        return ["the paper's dataset GeRoD, packed", "", commands[0]] if commands else []
    asked = [f"question: {line}" for line in layouts.questions(found)]
    return ["the paper's dataset GeRoD", *layouts.table(found), *asked, "", _gerod_command(folder)]


def _gerod_command(where: Path) -> str:
    return shlex.join(["flexroad", "catalog", "gerod", str(where), "-o", "gerod.parquet"])


def _files(folder: Path) -> Iterator[Path]:
    for parent, folders, names in os.walk(folder):
        if RUN_FILE in names:
            # A run and its products.
            folders.clear()
            continue
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        if len(Path(parent).relative_to(folder).parts) >= MAX_DEPTH:
            folders.clear()
        yield from (Path(parent, name) for name in sorted(names) if not name.startswith("."))


def _raster(path: Path, folder: Path) -> Iterator[Download]:
    """Yield a raster as a download; nothing for a text to read."""
    try:
        with quiet(), open_raster(path) as raster:
            bands, dtype, size = raster.count, raster.dtypes[0], f"{raster.width} x {raster.height}"
            crs = in_plan(raster.crs.to_wkt()) if raster.crs else None
            values = _values(raster)
    except (*ERRORS, CatalogError) as error:
        if path.suffix.lower() != ".txt":
            yield Download(path, "raster", question=f"it cannot be read as a raster: {error}")
        return
    kind = layouts.layer_of(path.relative_to(folder).as_posix()) or "raster"
    about = f"{count(bands, 'band')} {dtype}, {size}, {values[0]}, {short(crs) if crs else 'no CRS'}"
    question = QUESTIONS.get(kind, "")
    if bands >= 3 and kind in ("dsm", "dtm", "raster"):
        question = "" if kind == "raster" else f"it is named like a {kind}, but has {bands} bands"
        kind = "dop"
    elif bands == 1 and kind == "dop":
        question = "it is named like an orthophoto, but has one band"
    elif kind == "road_mask":
        question = _of_mask(values[1])
    metric = crs is None or plan_unit(crs)[1] == 1.0
    if crs is None:
        question = question or NO_CRS
    yield Download(path, kind, about, short(crs) if crs else None, question, metric)


def _of_mask(values: str) -> str:
    """Return the question about a mask with these values; empty if every value except 0 can be road."""
    if not values:
        return "it is named like a mask, but has many values: is it one?"
    if len(set(values.split(", ")) - {"0"}) <= 1:
        return ""
    return f"which of its values are road (--road-value)? It has {values}"


def _values(raster: Any) -> tuple[str, str]:
    """Return the range of the first band's values, and the values if they are few whole numbers."""
    shape = (min(raster.height, PREVIEW), min(raster.width, PREVIEW))
    cells = read_valid(raster, out_shape=shape).compressed()
    cells = cells[np.isfinite(cells)] * raster.scales[0] + raster.offsets[0]
    if not cells.size:
        return "only nodata", ""
    distinct = np.unique(cells)
    few = distinct.size <= FEW_VALUES and bool((distinct == np.round(distinct)).all())
    values = ", ".join(f"{value:g}" for value in distinct) if few else ""
    return f"values {cells.min():g} to {cells.max():g}", values


def _cloud(path: Path) -> Download:
    try:
        cloud = inspect(path)
    except CatalogError as error:
        return Download(path, "cloud", question=str(error))
    crs = short(cloud.crs) if cloud.crs else None
    low, high = cloud.heights
    about = f"{cloud.points:,} points, heights {low:.0f} to {high:.0f}, {crs or 'no CRS'}"
    return Download(path, "cloud", about, crs, "" if crs else NO_CRS)


def _vectors(path: Path) -> Download:
    try:
        layers = layers_of(path)
    except (RuntimeError, ValueError, OSError) as error:
        return Download(path, "vector", question=f"it cannot be read as vectors: {error}")
    if not any(re.search(ROADS, name.lower()) for name in (path.stem, *layers)):
        unclear = "are these roads? If so, give it with --roads"
        return Download(path, "vector", listed(layers), question=unclear)
    question = "which layer are the roads (--roads FILE|layername=NAME)?" if len(layers) > 1 else ""
    return Download(path, "roads", listed(layers), question=question)


def proposals(folder: Path, found: Sequence[Download]) -> Iterator[Proposal]:
    """Yield the commands that fit the downloads of a folder."""
    by_kind: dict[str, list[Download]] = defaultdict(list)
    for download in found:
        by_kind[download.kind].append(download)
    yield from _of_rasters(folder, by_kind)
    for number, (kind, inputs, crs) in enumerate(_sources(folder, by_kind)):
        out = Path(f"{_title(folder)}_{kind}{number or ''}")
        roads = _roads(by_kind)
        words = ["flexroad", "prepare", *map(str, inputs), "-o", str(out), *roads]
        lacking = [] if roads else ["--roads FILE with the roads of the area"]
        lacking += [LAYER] if roads and by_kind["roads"][0].question else []
        lacking += ["--crs"] if kind == "points" and crs is None else []
        catalog = out / "catalog.parquet"
        # Areas become a road mask, lines stay vectors: the command prints the next step.
        yield Proposal(shlex.join(words), catalog, "", _listed(lacking))


def _title(folder: Path) -> str:
    return folder.resolve().name or "data"


def _roads(by_kind: Mapping[str, Sequence[Download]]) -> list[str]:
    """Return the option that names the vector file of roads, if there is only one."""
    files = by_kind["roads"]
    return ["--roads", str(files[0].path.absolute())] if len(files) == 1 else []


def _sources(
    folder: Path, by_kind: Mapping[str, Sequence[Download]]
) -> Iterator[tuple[str, list[Path], str | None]]:
    """Yield the kind, the inputs and the CRS of each ``flexroad prepare`` command."""
    if is_project(folder):
        yield "odm", [folder], None
        return
    clouds, meshes = by_kind["cloud"], {mesh.path.parent for mesh in by_kind["mesh"]}
    for crs in dict.fromkeys(cloud.crs for cloud in clouds):
        files = [cloud.path for cloud in clouds if cloud.crs == crs]
        others = meshes | {cloud.path.parent for cloud in clouds if cloud.crs != crs}
        # A folder is given instead of its files if they belong together.
        names = dict.fromkeys(file if file.parent in others else file.parent for file in files)
        yield "points", list(names), crs
    for mesh in by_kind["mesh"]:
        yield "mesh", [mesh.path], None
    # Images next to points or a mesh are previews or textures.
    beside = meshes | {cloud.path.parent for cloud in clouds}
    if photos := {photo.path.parent for photo in by_kind["photo"]} - beside:
        yield "photos", sorted(photos), None


def _of_rasters(folder: Path, by_kind: Mapping[str, Sequence[Download]]) -> Iterator[Proposal]:
    """Yield a command for the rasters of each CRS, or one command if all surface models have the same CRS.

    Downloads of Geobasis NRW have a separate command.
    """
    rasters = [download for layer in LAYERS for download in by_kind[layer]]
    systems = dict.fromkeys(download.crs for download in rasters if download.kind in ("dsm", "dtm"))
    surfaces = dict.fromkeys(download.crs for download in by_kind["dsm"])
    # A layer in another CRS is warped to the only CRS of the surface models.
    mixed = len(surfaces) == 1 and any(d.crs not in (None, *surfaces) for d in rasters)
    for number, crs in enumerate(surfaces if mixed else systems):
        chosen = [d for d in rasters if d.crs == crs or (mixed and d.crs is not None)]
        output = Path(f"{_title(folder)}{number + 1 if number else ''}.parquet")
        layers = {download.kind for download in chosen}
        lacking = [f"--{layer} FILES" for layer in ("dsm", "dtm") if layer not in layers]
        words = ["flexroad", "catalog", "rasters", str(folder)]
        if any(nrw.parse(download.path) for download in chosen if download.kind == "dsm"):
            words = ["flexroad", "catalog", "nrw", str(folder)]
            layers, lacking = layers & {"road_mask"}, ["the DTM (dgm1)"] if "dtm" not in layers else []
        for layer in (layer for layer in LAYERS if layer in layers):
            pattern = _pattern(folder, [download.path for download in chosen if download.kind == layer])
            if pattern:
                words += [f"--{layer.replace('_', '-')}", pattern]
            else:
                lacking.append(f"--{layer.replace('_', '-')} FILES: no one pattern has just these files")
        in_metres = all(download.metric for download in chosen if download.kind == "dsm")
        words += ["--reproject"] if mixed or not in_metres else []
        lacking += [] if in_metres else ["--to-crs with a CRS in metres"]
        roads = [] if "road_mask" in layers else _roads(by_kind)
        words += roads
        has = "road_mask" if "road_mask" in layers else "roads" if roads else ""
        if roads and by_kind["roads"][0].question:
            lacking.append(LAYER)
        if not has:
            lacking.append("--road-mask or --roads with the roads")
        if any(download.question for download in chosen if download.kind == "road_mask"):
            lacking.append("--road-value with the values of the mask that are road")
        if crs is None:
            lacking.append("--crs")
        yield Proposal(shlex.join([*words, "-o", str(output)]), output, has, _listed(lacking))


def _listed(lacking: Sequence[str]) -> str:
    return f"add {'; '.join(lacking)}" if lacking else ""


def _pattern(folder: Path, paths: Sequence[Path]) -> str | None:
    """Return a pattern relative to a folder that matches exactly these files; None if no pattern does."""
    names = sorted(path.relative_to(folder).as_posix() for path in paths)
    if len(names) == 1:
        return glob.escape(names[0])
    start = os.path.commonprefix(names)  # noqa: RUF071 (of characters)
    end = os.path.commonprefix([name[::-1] for name in names])[::-1]  # noqa: RUF071
    above = start[: start.rfind("/") + 1]
    # Whole names are replaced first: names of later files may have no part in common with these.
    for first, middle, last in (
        (above, "*", Path(names[0]).suffix),
        (start, "*", end),
        (start, "**/*", end),
    ):
        pattern = glob.escape(first) + middle + glob.escape(last)
        try:
            matched = sorted(path.relative_to(folder).as_posix() for path in folder.glob(pattern))
        except ValueError:
            continue
        if matched == names:
            return pattern
    return None
