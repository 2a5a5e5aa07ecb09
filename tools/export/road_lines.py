"""Roads as lines in space, with grade and crossfall for each metre, as a GeoPackage for GIS programs."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from flexroad.catalog.lazy import lazy
from flexroad.tasks.errors import TaskError
from flexroad.tasks.io.vectors import vector_date
from flexroad.tasks.quality.height_source import HeightSource
from flexroad.tasks.types import Floats

pyogrio = lazy("pyogrio")

VERSION = 2
NAME = "_roads.gpkg"
MEDIA_TYPE = "application/geopackage+sqlite3"

ROADS, SEGMENTS = "roads", "segments"
"""Layers of the file."""
BATCH = 50_000
"""Number of segments that are written at once."""
HEIGHT_SOURCE = {
    HeightSource.MEASURED: "measured",
    HeightSource.DTM: "dtm",
    HeightSource.INFERRED: "inferred",
}
"""Values of the column ``height_source``."""


@dataclass(frozen=True, eq=False)
class RoadLine:
    """One road of ``n`` segments."""

    road: Mapping[str, str | int | float | None]
    """Its columns in the layer ``roads``; the first one is its id."""
    points: Floats
    """``(n + 1, 3)``: easting, northing, height (m)."""
    segments: Mapping[str, Floats]
    """Columns of the layer ``segments``, ``(n,)`` each."""
    height_source: NDArray[np.uint8]
    """Class of each segment by `HeightSource`, ``(n,)``."""


def write(path: Path, roads: Iterable[RoadLine], crs: str, date: datetime) -> None:
    """Write roads to a new GeoPackage.

    The layer ``roads`` has a line per road, ``segments`` a line per metre. Numbers that are not known are
    null.

    - `roads`: at least one; all with the same columns.
    - `crs`: CRS of the points, compound if that of the heights is known.
    - `date`: date of the data (UTC), so that equal roads give equal bytes.
    """
    batch: list[RoadLine] = []
    new = True
    with vector_date(date):
        for road in roads:
            batch.append(road)
            if sum(len(each.height_source) for each in batch) >= BATCH:
                _append(path, batch, crs, new)
                batch, new = [], False
        if batch:
            _append(path, batch, crs, new)


def _append(path: Path, batch: list[RoadLine], crs: str, new: bool) -> None:
    lines = shapely.linestrings(
        np.concatenate([road.points for road in batch]),
        indices=np.repeat(np.arange(len(batch)), [len(road.points) for road in batch]),
    )
    columns = {name: [road.road[name] for road in batch] for name in batch[0].road}
    _table(path, ROADS, lines, {name: _column(values) for name, values in columns.items()}, crs, new)
    pairs = np.concatenate([np.stack([road.points[:-1], road.points[1:]], axis=1) for road in batch])
    key = next(iter(columns))
    numbers = {name: np.concatenate([road.segments[name] for road in batch]) for name in batch[0].segments}
    height_source = np.concatenate([road.height_source for road in batch])
    names = np.array([HEIGHT_SOURCE.get(HeightSource(kind)) for kind in range(len(HeightSource))], object)
    owner = np.repeat(_column(columns[key]), [len(road.height_source) for road in batch])
    values = {f"road_{key}": owner, **numbers, "height_source": names[height_source]}
    _table(path, SEGMENTS, shapely.linestrings(pairs), values, crs, new)


def _column(values: list[Any]) -> NDArray[Any]:
    """Return a column of numbers, with NaN for None, or of texts."""
    if any(isinstance(value, str) for value in values):
        return np.array(values, object)
    if all(isinstance(value, int) for value in values):
        return np.array(values, np.int64)
    return np.array([np.nan if value is None else value for value in values], np.float64)


def _table(
    path: Path, layer: str, lines: NDArray[np.object_], columns: Mapping[str, Any], crs: str, new: bool
) -> None:
    kinds = pyogrio.errors
    unwritable = kinds.DataLayerError, kinds.DataSourceError, kinds.FeatureError, kinds.GeometryError
    try:
        pyogrio.raw.write(
            path,
            geometry=shapely.to_wkb(lines, output_dimension=3),
            field_data=list(columns.values()),
            fields=np.array(list(columns), object),
            layer=layer,
            driver="GPKG",
            geometry_type="LineString Z",
            crs=crs,
            append=not new,
            nan_as_null=True,
        )
    except unwritable as error:
        raise TaskError(f"{path} cannot be written: {error}; check the disk") from error
