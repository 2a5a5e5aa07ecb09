"""Whether the spatial index of a vector layer has all of its features, and where these really are.

GDAL believes an index, and does not return a feature that it lacks or has elsewhere. Programs leave such
indexes that edit a GeoPackage without its triggers, or a Shapefile without the ``.qix`` beside it.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from flexroad.catalog.grid import Bounds, union
from flexroad.catalog.guard.sqlite_contents import opened, quoted
from flexroad.catalog.lazy import lazy

pyogrio = lazy("pyogrio")

SQLITE = ("GPKG", "SQLite")
"""GDAL's drivers of formats in SQLite."""
EDITED = (*SQLITE, "ESRI Shapefile")
"""Those of formats whose features programs change in place, so that index and bounds may be of other ones."""
BOXES = np.dtype(
    [("feature", np.int64), *((edge, np.float32) for edge in ("west", "east", "south", "north"))]
)
"""Rows of an R-tree of SQLite, which rounds boxes outwards."""


def has_complete_index(file: str, info: Mapping[str, Any]) -> bool:
    """Return whether each feature of a layer is in its index, within its box there.

    - `file`: GDAL's name of the file.
    - `info`: what pyogrio knows of the layer.
    - result: also False of a view, whose index is the table's, and of a Shapefile: its index is not read
      here.
    """
    if not info["capabilities"]["fast_spatial_filter"] or info["driver"] not in SQLITE:
        return bool(info["capabilities"]["fast_spatial_filter"]) and info["driver"] not in EDITED
    index = _boxes(Path(file.removeprefix("SQLITE:")), f"{info['layer_name']}_{info['geometry_name']}")
    features, boxes = pyogrio.read_bounds(file, layer=info["layer_name"])
    placed = np.isfinite(boxes).all(axis=0)
    features, (west, south, east, north) = features[placed], boxes[:, placed]
    order = np.argsort(index["feature"])
    index = index[order]
    at = np.searchsorted(index["feature"], features)
    if at.size and at.max() >= index.size:
        return False
    found = index[at]
    inside = (found["west"] <= west) & (found["south"] <= south)
    inside &= (found["east"] >= east) & (found["north"] >= north)
    return bool(((found["feature"] == features) & inside).all())


def _boxes(path: Path, layer: str) -> np.ndarray[Any, Any]:
    """Return the boxes of the R-tree of a table and column; none if there is no such one."""
    names = f"rtree_{layer}".lower(), f"idx_{layer}".lower()
    with opened(path) as data:
        try:
            tables = data.execute(
                "SELECT name FROM sqlite_master WHERE lower(name) IN (?, ?)", names
            ).fetchall()
            return np.fromiter(data.execute(f"SELECT * FROM {quoted(tables[0][0])}"), BOXES)
        except (sqlite3.Error, IndexError, ValueError):
            return np.empty(0, BOXES)


def real_bounds(file: str, info: Mapping[str, Any]) -> Bounds | None:
    """Return the bounds of a layer with all of its features, None if it has none; `has_complete_index`."""
    stated: Bounds | None = info["total_bounds"]
    if info["driver"] not in EDITED:
        return stated
    _, boxes = pyogrio.read_bounds(file, layer=info["layer_name"])
    boxes = boxes[:, np.isfinite(boxes).all(axis=0)]
    if not boxes.size:
        return stated
    west, south = map(float, boxes[:2].min(axis=1))
    east, north = map(float, boxes[2:].max(axis=1))
    real = west, south, east, north
    return union([real, stated]) if stated else real
