"""What the files of a folder of downloads look like: their kind by name, checked by their content."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from flexroad.catalog.errors import CatalogError
from flexroad.catalog.text import count

MAX_FILES = 5000
"""Largest number of files that are looked at."""
MAX_DEPTH = 8
"""Largest depth of folders below the given one."""
PREVIEW = 256
"""Side of the reduced raster that the range of values is read from (cells)."""
FEW_VALUES = 40
"""Largest number of distinct values of a mask or land cover."""

SUFFIXES = {
    "raster": (".tif", ".tiff", ".asc", ".xyz", ".gz", ".vrt", ".jp2"),
    "cloud": (".las", ".laz"),
    "vector": (".gpkg", ".shp", ".geojson", ".fgb", ".osm", ".pbf"),
    "mesh": (".obj", ".ply", ".gltf", ".glb"),
    "photo": (".jpg", ".jpeg"),
    "archive": (".zip", ".7z", ".tar", ".tgz", ".rar"),
}
"""Kind -> endings of its files; a raster's layer is then told by its name."""
NAMES = (
    ("above_ground", r"n(dom|dsm)|cdsm|chm|dhm|mnh|ndhm"),
    ("road_height", r"road.?heights?"),
    ("dsm", r"dsm|dom|mns|mds|surface"),
    ("dtm", r"dtm|dgm|dem|mnt|mdt|terrain|ground|bare"),
    ("dop", r"dop|ortho|orthophoto|rgbi?|cir"),
    ("road_mask", r"mask|landcover|land.?use|roads?"),
)
"""Layer and the words in names of files or folders that mean it, the first match first."""
ROADS = r"road|street|stra(ss|ß)e|highway|carriage|route|centre.?line|center.?line|osm"
"""Words in names of vector files and their layers that mean roads."""
QUESTIONS = {
    "above_ground": "heights above the ground are no surface model; which file has the heights of surface?",
    "raster": "is it a DSM (--dsm), a DTM (--dtm), an orthophoto (--dop) or a road mask (--road-mask)?",
    "archive": "unpack it first",
}
"""Kind of a file that no command takes as it is -> what the user must decide or do."""
NO_CRS = "it has no CRS: which is it (--crs)?"


@dataclass(frozen=True)
class Download:
    """One file and what it looks like."""

    path: Path
    kind: str
    """A layer of the catalog, or a key of `SUFFIXES` or `QUESTIONS`."""
    about: str = ""
    """Bands, type, range of values, CRS, as far as the kind has them."""
    crs: str | None = None
    """Of rasters and clouds: the short name of their CRS, None if the file has none."""
    question: str = ""
    """What the user must decide; empty if nothing."""
    metric: bool = True
    """False for a raster whose CRS is in feet or degrees."""


def look(folder: Path) -> tuple[list[Download], bool]:
    """Return the downloads below a folder, by path, and whether the folder has more files than looked at.

    Raises
    ------
    CatalogError
        If the folder does not exist.
    """
    if not folder.is_dir():
        raise CatalogError(f"folder {folder} does not exist; name the folder of the downloads")
    kinds = {suffix: kind for kind, suffixes in SUFFIXES.items() for suffix in suffixes}
    found: list[Download] = []
    for number, path in enumerate(_files(folder)):
        if number == MAX_FILES:
            return found, True
        if kind := kinds.get(path.suffix.lower()):
            found.append(_looked(path, folder, kind))
    return found, False


def _files(folder: Path) -> Iterator[Path]:
    for parent, folders, names in os.walk(folder):
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        if len(Path(parent).relative_to(folder).parts) >= MAX_DEPTH:
            folders.clear()
        yield from (Path(parent, name) for name in sorted(names) if not name.startswith("."))


def _looked(path: Path, folder: Path, kind: str) -> Download:
    if kind == "raster":
        return _raster(path, folder)
    if kind == "cloud":
        return _cloud(path)
    if kind == "vector":
        return _vectors(path)
    return Download(path, kind, question=QUESTIONS.get(kind, ""))


def _named(path: Path, folder: Path) -> str:
    """Return the layer that the name of a file means, else that of the folder it lies in, else ``raster``."""
    relative = path.relative_to(folder)
    for name in (relative.stem, *reversed(relative.parts[:-1])):
        for kind, words in NAMES:
            if re.search(rf"(?<![a-z])({words})(?![a-z])", name.lower()):
                return kind
    return "raster"


def _raster(path: Path, folder: Path) -> Download:
    from flexroad.catalog.crs import in_plan, plan_unit, short
    from flexroad.catalog.headers.open_raster import ERRORS, open_raster
    from flexroad.catalog.headers.rasters import quiet

    try:
        with quiet(), open_raster(path) as raster:
            bands, dtype, size = raster.count, raster.dtypes[0], f"{raster.width} x {raster.height}"
            crs = in_plan(raster.crs.to_wkt()) if raster.crs else None
            values = _values(raster)
    except (*ERRORS, CatalogError) as error:
        return Download(path, "raster", question=f"it cannot be read as a raster: {error}")
    kind = _named(path, folder)
    about = f"{count(bands, 'band')} {dtype}, {size}, {values[0]}, {short(crs) if crs else 'no CRS'}"
    question = QUESTIONS.get(kind, "")
    if bands >= 3 and kind in ("dsm", "dtm", "raster"):
        kind, question = (
            "dop",
            "" if kind == "raster" else f"it is named like a {kind}, but has {bands} bands",
        )
    elif bands == 1 and kind == "dop":
        question = "it is named like an orthophoto, but has one band"
    elif kind == "road_mask":
        question = _of_mask(values[1])
    metric = crs is None or plan_unit(crs)[1] == 1.0
    if crs is None:
        question = question or NO_CRS
    return Download(path, kind, about, short(crs) if crs else None, question, metric)


def _of_mask(values: str) -> str:
    """Return the question about a mask with these values; empty if every value but 0 can be road."""
    if not values:
        return "it is named like a mask, but has many values: is it one?"
    if len(set(values.split(", ")) - {"0"}) <= 1:
        return ""
    return f"which of its values are road (--road-value)? It has {values}"


def _values(raster: Any) -> tuple[str, str]:
    """Return the range of the first band's values, and the values if they are few whole numbers."""
    import numpy as np

    shape = (min(raster.height, PREVIEW), min(raster.width, PREVIEW))
    cells = raster.read(1, out_shape=shape, masked=True).compressed()
    cells = cells[np.isfinite(cells)]
    if not cells.size:
        return "only nodata", ""
    distinct = np.unique(cells)
    few = distinct.size <= FEW_VALUES and bool((distinct == np.round(distinct)).all())
    listed = ", ".join(f"{value:g}" for value in distinct) if few else ""
    return f"values {cells.min():g} to {cells.max():g}", listed


def _cloud(path: Path) -> Download:
    from flexroad.catalog.crs import short
    from flexroad.catalog.headers.point_clouds import inspect

    try:
        cloud = inspect(path)
    except CatalogError as error:
        return Download(path, "cloud", question=str(error))
    crs = short(cloud.crs) if cloud.crs else None
    low, high = cloud.heights
    about = f"{cloud.points:,} points, heights {low:.0f} to {high:.0f}, {crs or 'no CRS'}"
    return Download(path, "cloud", about, crs, "" if crs else NO_CRS)


def _vectors(path: Path) -> Download:
    from flexroad.catalog.headers.vectors import layers as layers_of
    from flexroad.catalog.headers.vectors import listed

    try:
        layers = layers_of(path)
    except (RuntimeError, ValueError, OSError) as error:
        return Download(path, "vector", question=f"it cannot be read as vectors: {error}")
    if not any(re.search(ROADS, name.lower()) for name in (path.stem, *layers)):
        unclear = "are these roads? If so, give it with --roads"
        return Download(path, "vector", listed(layers), question=unclear)
    question = "which layer are the roads (--roads-layer)?" if len(layers) > 1 else ""
    return Download(path, "roads", listed(layers), question=question)
