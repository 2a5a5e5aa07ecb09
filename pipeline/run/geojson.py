"""Map of the state of every tile of a run (``RUN/tiles.geojson``), for QGIS and other programs."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

import numpy as np
import shapely

from flexroad.catalog import Tile
from flexroad.catalog.crs import transformer
from flexroad.catalog.storage.paths import Location, write
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.run.status import open_database, recorded
from flexroad.pipeline.store.database import TileState
from flexroad.pipeline.store.records import TileRecord

NAME = "tiles.geojson"
COLUMNS = ("id", "state", "stale", "error", "seconds", "error_estimate_m", "flags", "finished")


def write_states(run: Run, where: Location) -> None:
    """Write the tiles as polygons in longitude and latitude (WGS 84, RFC 7946).

    Columns: ``id``; ``state`` (``done``: computed by the last run; ``cached``: done before it; ``failed``;
    ``pending``); ``stale``, whether a failed or pending tile still has products of an earlier result;
    ``error``, the reason of a failure; ``seconds``, the computing time; ``error_estimate_m``, the error
    estimate of the surface exported first (m); ``flags``, its flags, such as ``no-road``; ``finished``, the
    time of completion.

    Raises
    ------
    OSError
        If the file cannot be written.
    """
    variant = run.config.export.variants[0]
    with open_database(run) as database:
        rows = [_row(tile_id, state, record, variant) for tile_id, state, record in recorded(run, database)]
    features = [
        {
            "id": row["id"],
            "type": "Feature",
            "properties": {name: row.get(name) for name in COLUMNS},
            "geometry": json.loads(outline) if outline else None,
        }
        for row, outline in zip(rows, shapely.to_geojson(outlines(run.catalog.tiles)), strict=True)
    ]
    collection = {"type": "FeatureCollection", "features": features}
    write(where, json.dumps(collection).encode(), run.config.cluster.flush)


def outlines(tiles: Sequence[Tile]) -> Any:
    """Return the outlines of tiles in longitude and latitude, an ``(n,)`` array of shapely polygons.

    Polygons are anticlockwise; coordinates are rounded to 1e-7 degrees (about 1 cm). Tiles of one CRS are
    transformed together. Tiles without a known position (`Tile.fault`) have None.
    """
    shapes = np.array([None if tile.fault else shapely.box(*tile.grid.bounds) for tile in tiles], object)
    crs_of_tile = np.array([tile.grid.crs for tile in tiles], object)
    for crs in set(crs_of_tile[shapes != None]):  # noqa: E711 (of each shape)
        selected = crs_of_tile == crs
        convert = transformer(crs, "EPSG:4326").transform
        shapes[selected] = shapely.transform(shapes[selected], convert, interleaved=False)
    # Beyond the range of a CRS coordinates are infinite.
    return np.where(
        shapely.is_valid(shapes), shapely.transform(shapes, lambda degrees: degrees.round(7)), None
    )


def _row(tile_id: str, state: TileState, record: TileRecord | None, variant: str) -> dict[str, Any]:
    stale = state in ("failed", "pending") and record is not None and record.has_products
    row: dict[str, Any] = {"id": tile_id, "state": state, "stale": stale}
    # The record of a pending tile belongs to earlier files or options.
    if record is not None and state != "pending":
        row |= {"seconds": round(record.seconds, 3), "finished": record.finished or None}
        if record.failures:
            row["error"] = record.failures[0].line
        for metrics in record.rows:
            if metrics["variant"] == variant:
                row["error_estimate_m"] = metrics.get("error_estimate_m")
                row["flags"] = metrics.get("flags") or None
    return row
