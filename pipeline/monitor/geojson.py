"""A map of the state of every tile of a run: ``RUN/tiles.geojson``, for QGIS and other programs."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from flexroad.catalog import Tile
from flexroad.catalog.storage.paths import Location, write
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.store.database import NAME as DATABASE
from flexroad.pipeline.store.database import RunDatabase, TileState
from flexroad.pipeline.store.records import TileRecord

NAME = "tiles.geojson"
COLUMNS = ("id", "state", "error", "seconds", "error_estimate_m", "finished")


def write_states(run: Run, where: Location) -> None:
    """Write the tiles as polygons in longitude and latitude (WGS 84, RFC 7946).

    Each has its id, its ``state`` (done: by the last run; cached: found done by it; failed; pending), why it
    failed, the seconds it took, the doubt of the surface exported first (m), and when it was finished.

    Raises
    ------
    OSError
        If the file cannot be written.
    """
    from geopandas import GeoDataFrame

    left = {tile.id: tile for tile in run.catalog.tiles}
    with RunDatabase.open_readonly(run.path / DATABASE) as database:
        rows = [
            _row(left.pop(name), standing, entry, run.config.export.variants[0])
            for name, standing, entry in database.entries()
            if name in left
        ]
    # Tiles that are new since the last run.
    rows += [_row(tile, "pending", None, "") for tile in left.values()]
    table = GeoDataFrame(
        [row for _, row in rows], columns=COLUMNS, dtype=object, geometry=outlines([tile for tile, _ in rows])
    )
    write(where, table.set_index("id", drop=False).to_json().encode())


def outlines(tiles: Sequence[Tile]) -> Any:
    """Return the outline of each tile in longitude and latitude, an array of shapely polygons.

    Anticlockwise, and to 1 cm; one transformation for all tiles of a CRS.
    """
    from geopandas import GeoSeries
    from shapely import box, transform

    shapes = np.array([box(*tile.grid.bounds) for tile in tiles], object)
    systems = np.array([tile.grid.crs for tile in tiles], object)
    for crs in set(systems):
        here = systems == crs
        shapes[here] = GeoSeries(shapes[here], crs=crs).to_crs("EPSG:4326")
    return transform(shapes, lambda degrees: degrees.round(7))


def _row(
    tile: Tile, standing: TileState, entry: TileRecord | None, variant: str
) -> tuple[Tile, dict[str, Any]]:
    row: dict[str, Any] = {"id": tile.id, "state": standing}
    # The entry of a pending tile describes files or options that are no longer there.
    if entry is not None and standing != "pending":
        row |= {"seconds": round(entry.seconds, 3), "finished": entry.finished or None}
        if entry.failures:
            row["error"] = entry.failures[0].line
        for one in entry.rows:
            if one["variant"] == variant:
                row["error_estimate_m"] = one.get("error_estimate_m")
    return tile, row
