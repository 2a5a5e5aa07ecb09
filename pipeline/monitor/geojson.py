"""How every tile of a run stands, as a map: ``RUN/tiles.geojson``, for QGIS and other programs."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Sequence
from itertools import islice
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flexroad.catalog import Tile
from flexroad.catalog.crs import transformer
from flexroad.catalog.storage.paths import Place
from flexroad.catalog.storage.staging import whole
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.store.database import NAME as LEDGER
from flexroad.pipeline.store.database import Ledger, Standing
from flexroad.pipeline.store.records import Entry

NAME = "tiles.geojson"
AT_ONCE = 10_000
Known = tuple[Tile, Standing, Entry | None]


def write_states(run: Run, where: Place) -> None:
    """Write the tiles as polygons in longitude and latitude (WGS 84, RFC 7946).

    Each has its id, its ``state`` (done: by the last run; cached: found done by it; failed; pending), why it
    failed, the seconds it took, the doubt of the surface exported first (m), and when it was finished.

    Raises
    ------
    OSError
        If the file cannot be written.
    """
    with Ledger.peek(run.path / LEDGER) as ledger, whole(where) as path, path.open("w") as file:
        features = _features(_known(run.catalog.tiles, ledger), run.config.export.variants[0])
        file.write('{"type": "FeatureCollection", "features": [\n')
        file.write(next(features, ""))
        file.writelines(f",\n{feature}" for feature in features)
        file.write("\n]}\n")


def corners(tiles: Sequence[Tile]) -> NDArray[np.float64]:
    """Return the outline of each tile as (tile, corner, longitude and latitude), five corners each.

    Anticlockwise, and to 1 cm; one transformation for all tiles of a CRS.
    """
    rings = np.empty((len(tiles), 5, 2))
    systems = [tile.grid.crs for tile in tiles]
    west, south, east, north = np.array([tile.grid.bounds for tile in tiles]).T
    for crs in set(systems):
        here = np.array([system == crs for system in systems])
        eastings = np.stack([west, east, east, west, west], axis=1)[here]
        northings = np.stack([south, south, north, north, south], axis=1)[here]
        rings[here] = np.stack(transformer(crs, "EPSG:4326").transform(eastings, northings), axis=2)
    return rings.round(7)


def _known(tiles: Iterable[Tile], ledger: Ledger) -> Iterator[Known]:
    left = {tile.id: tile for tile in tiles}
    for name, standing, entry in ledger.entries():
        tile = left.pop(name, None)
        if tile is not None:
            yield tile, standing, entry
    for tile in left.values():
        # New since the last run.
        yield tile, "pending", None


def _features(known: Iterator[Known], variant: str) -> Iterator[str]:
    while some := list(islice(known, AT_ONCE)):
        rings = corners([tile for tile, _, _ in some])
        for (tile, standing, entry), ring in zip(some, rings, strict=True):
            feature = {
                "type": "Feature",
                "id": tile.id,
                "geometry": {"type": "Polygon", "coordinates": [ring.tolist()]},
                "properties": {"id": tile.id, "state": standing, **_told(standing, entry, variant)},
            }
            yield json.dumps(feature)


def _told(standing: Standing, entry: Entry | None, variant: str) -> dict[str, Any]:
    """Return the same fields of every tile, so that programs see columns."""
    told: dict[str, Any] = dict.fromkeys(("error", "seconds", "doubt_m", "finished"))
    # What is known of a pending tile is of files or options that are no more.
    if entry is None or standing == "pending":
        return told
    told |= {"seconds": round(entry.seconds, 3), "finished": entry.finished or None}
    if entry.failures:
        told["error"] = entry.failures[0].line
    for row in entry.rows:
        if row["variant"] == variant:
            told["doubt_m"] = row.get("doubt_m")
    return told
