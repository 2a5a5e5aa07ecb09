"""The STAC collection of a run, ``RUN/collection.json``: the way to the items of its done tiles."""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Sequence
from typing import Any

from flexroad.catalog import Tile
from flexroad.catalog.crs import bounds_in
from flexroad.catalog.grid import Bounds
from flexroad.catalog.ids import safe_name
from flexroad.catalog.index import PROJECTION, STAC_VERSION, datetime_text
from flexroad.catalog.storage.paths import remove, write
from flexroad.catalog.text import count
from flexroad.pipeline.run.mosaic import vrt_name, write_mosaics
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.store.records import DONE
from flexroad.pipeline.worker.exports import Kind
from flexroad.pipeline.worker.stac import COLLECTION, EXTENSIONS, GEOJSON, JSON, item_assets

METRICS = {
    "href": "./metrics.parquet",
    "type": "application/vnd.apache.parquet",
    "title": "One row per tile and variant",
    "roles": ["metadata"],
}
VRT = "application/xml"
"""Media type of mosaics; GDAL's format has none of its own."""


def write_collection(run: Run, done: Sequence[Tile]) -> None:
    """Write the mosaics and the collection of the done tiles; without any, remove older files.

    Raises
    ------
    OSError
        If a file cannot be written.
    """
    mosaics = write_mosaics(run, done)
    if not done:
        remove(run.path / COLLECTION)
        return
    content = json.dumps(collection(run, done, mosaics), indent=1, allow_nan=False).encode()
    write(run.path / COLLECTION, content, run.config.cluster.flush)


def collection(run: Run, done: Sequence[Tile], mosaics: Sequence[Kind]) -> dict[str, Any]:
    """Return the collection of the done tiles, at least one, with the mosaics that exist."""
    times = [tile.datetime for tile in done]
    cells = {tile.grid.cell for tile in done}
    export = run.config.export
    codes = sorted({tile.grid.crs for tile in done if tile.grid.has_code})
    return {
        "type": "Collection",
        "stac_version": STAC_VERSION,
        "stac_extensions": [PROJECTION, *EXTENSIONS],
        "id": run.collection,
        "title": run.collection,
        "description": f"Road surfaces of {count(len(done), 'tile')} by FlexRoad, "
        f"configuration {run.config.name}",
        # The licence of the results depends on that of the sources.
        "license": "other",
        "extent": {
            "spatial": {"bbox": [_degrees(done)]},
            "temporal": {"interval": [[datetime_text(min(times)), datetime_text(max(times))]]},
        },
        "summaries": {"gsd": sorted(cells)} | ({"proj:code": codes} if codes else {}),
        "item_assets": item_assets(export.variants, export.formats, cells),
        "assets": {"metrics": METRICS} | {kind.key: _mosaic(kind) for kind in mosaics},
        "links": [
            {"rel": "root", "href": f"./{COLLECTION}", "type": JSON, "title": run.collection},
            *(_item_link(tile) for tile in done),
        ],
    }


def _mosaic(kind: Kind) -> dict[str, Any]:
    return {
        "href": f"./{vrt_name(kind)}",
        "type": VRT,
        "title": f"{kind.title}, all tiles, as GDAL VRT",
        "roles": ["data"],
    }


def _item_link(tile: Tile) -> dict[str, str]:
    return {"rel": "item", "href": f"./tiles/{safe_name(tile.id)}/{DONE}", "type": GEOJSON, "title": tile.id}


def _degrees(tiles: Sequence[Tile]) -> Bounds:
    """Return the bounds of tiles in degrees; those of the Earth where none of them can be transformed."""
    by_crs: defaultdict[str, list[Bounds]] = defaultdict(list)
    for tile in tiles:
        by_crs[tile.grid.crs].append(tile.grid.bounds)
    parts = [bounds_in("EPSG:4326", crs, _union(bounds)) for crs, bounds in by_crs.items()]
    known = [part for part in parts if abs(part[0]) <= 180 and abs(part[3]) <= 90]
    return _union(known) if known else (-180.0, -90.0, 180.0, 90.0)


def _union(bounds: Sequence[Bounds]) -> Bounds:
    wests, souths, easts, norths = zip(*bounds, strict=True)
    return min(wests), min(souths), max(easts), max(norths)
