"""Files that describe all tiles of a run, for other programs.

``RUN/collection.json`` is a STAC collection that links the items of the done tiles. ``RUN/height.vrt`` and
the other mosaics join the rasters of the tiles, in GDAL's format VRT. They are written as a stream, because a
state has hundreds of thousands of tiles; rasterio has no writer for them. ``RUN/tiles.geojson`` is a map of
the state of every tile.
"""

from __future__ import annotations

import json
import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any
from xml.sax.saxutils import XMLGenerator, escape
from xml.sax.xmlreader import AttributesImpl

import numpy as np
import shapely

from flexroad.catalog import Grid, Tile
from flexroad.catalog.crs import bounds_in, transformer
from flexroad.catalog.grid import Bounds, union
from flexroad.catalog.ids import safe_name
from flexroad.catalog.index import PROJECTION, STAC_VERSION, datetime_text
from flexroad.catalog.storage.buckets import atomic_file
from flexroad.catalog.storage.paths import Location, remove, write
from flexroad.catalog.text import count
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.run.status import known_record, open_database, recorded
from flexroad.pipeline.store.records import DONE, TileRecord, TileState
from flexroad.pipeline.worker.exports import (
    COLLECTION,
    EXTENSIONS,
    GEOJSON,
    HEIGHT,
    JSON,
    KINDS,
    Kind,
    file_name,
    item_assets,
    of_level,
)
from flexroad.tasks.products import cog
from flexroad.tasks.products.cog import BLOCK, NAME_STYLE, Band, encode_style

MAP = "tiles.geojson"
MAP_COLUMNS = ("id", "state", "stale", "error", "seconds", "error_estimate_m", "flags", "finished")
METRICS = {
    "href": "./metrics.parquet",
    "type": "application/vnd.apache.parquet",
    "title": "One row per tile and variant",
    "roles": ["metadata"],
}
VRT = "application/xml"
"""Media type of mosaics; VRT has no registered type."""
TYPES = {"float32": "Float32", "uint8": "Byte"}
"""GDAL's names of the types of cells."""


def write_collection(run: Run, done: Sequence[Tile]) -> None:
    """Write the mosaics and the collection of the done tiles; without any, remove older files."""
    mosaics = write_mosaics(run, done)
    if not done:
        remove(run.path / COLLECTION)
        return
    content = collection(run, done, mosaics)
    # It is written as a stream, because the parts of its text take more memory than the catalog.
    with atomic_file(run.path / COLLECTION, run.config.cluster.flush) as local, local.open("w") as file:
        json.dump(content, file, indent=1, allow_nan=False)


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
        # The licence of the results depends on the licence of the sources.
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
            *(
                {"rel": "item", "href": f"./tiles/{safe_name(t.id)}/{DONE}", "type": GEOJSON, "title": t.id}
                for t in done
            ),
        ],
    }


def _mosaic(kind: Kind) -> dict[str, Any]:
    return {
        "href": f"./{vrt_name(kind)}",
        "type": VRT,
        "title": f"{kind.title}, all tiles, as GDAL VRT",
        "roles": ["data"],
    }


def _degrees(tiles: Sequence[Tile]) -> Bounds:
    """Return the bounds of tiles in degrees; the bounds of the Earth if no tile can be transformed."""
    by_crs: defaultdict[str, list[Bounds]] = defaultdict(list)
    for tile in tiles:
        by_crs[tile.grid.crs].append(tile.grid.bounds)
    parts = [bounds_in("EPSG:4326", crs, union(bounds)) for crs, bounds in by_crs.items()]
    known = [part for part in parts if abs(part[0]) <= 180 and abs(part[3]) <= 90]
    return union(known) if known else (-180.0, -90.0, 180.0, 90.0)


def write_mosaics(run: Run, done: Sequence[Tile]) -> list[Kind]:
    """Write a VRT and its style for QGIS for each raster of the main variant over the done tiles.

    Their kinds are returned.

    Without a common lattice or exported rasters there are no mosaics; older files are then removed.
    """
    grid = Grid.holding([tile.grid for tile in done]) if "cog" in run.config.export.formats else None
    written = []
    for kind in KINDS["cog"]:
        if grid is None or kind.band is None:
            _remove_vrt(run, kind)
            continue
        _write_vrt(run, grid, kind, kind.band, done)
        written.append(kind)
    return written + _write_level_0(run, grid, done)


def _write_level_0(run: Run, grid: Grid | None, done: Sequence[Tile]) -> list[Kind]:
    """Write the mosaic of the ground below decks, if there are decks, and return its kind."""
    kind, variant = of_level(HEIGHT, 0), run.config.export.variants[0]
    names = dict[str, str]()
    if grid and getattr(run.config.chains[variant]["segment"], "levels", False):
        with open_database(run) as database:
            for tile in done:
                record, name = known_record(run, database, tile.id), file_name(tile.id, variant, kind)
                if record and name in record.sizes:
                    names[tile.id] = name
    if grid is None or not names:
        _remove_vrt(run, kind)
        return []
    _write_vrt(run, grid, kind, cog.HEIGHT, done, names)
    return [kind]


def _remove_vrt(run: Run, kind: Kind) -> None:
    remove(run.path / vrt_name(kind))
    if isinstance(run.path, Path):
        remove(run.path / _style_name(kind))


def _style_name(kind: Kind) -> str:
    return f"{kind.key}{NAME_STYLE}"


def vrt_name(kind: Kind) -> str:
    """Return the name of the mosaic of a kind of raster."""
    return f"{kind.key}.vrt"


def _write_vrt(
    run: Run, grid: Grid, kind: Kind, band: Band, tiles: Sequence[Tile], own: Mapping[str, str] | None = None
) -> None:
    """Write a mosaic of one kind of raster, and on disk its style: QGIS does not look for styles in buckets.

    - `own`: names of files of this kind, by tile; other tiles have the heights of their highest level. By
      default all tiles have a file of this kind.
    """
    variant, flush = run.config.export.variants[0], run.config.cluster.flush
    with atomic_file(run.path / vrt_name(kind), flush) as local, local.open("w", encoding="utf-8") as file:
        xml = XMLGenerator(file, "utf-8", short_empty_elements=True)
        _begin(xml, "VRTDataset", rasterXSize=str(grid.width), rasterYSize=str(grid.height))
        _leaf(xml, "SRS", grid.crs)
        _leaf(xml, "GeoTransform", f"{grid.west!r}, {grid.cell!r}, 0.0, {grid.north!r}, 0.0, {-grid.cell!r}")
        _begin(xml, "VRTRasterBand", dataType=TYPES[band.dtype], band="1")
        _describe(xml, band)
        for tile in tiles:
            name = file_name(tile.id, variant, kind if own is None else HEIGHT)
            name = name if own is None else own.get(tile.id, name)
            _source(xml, f"tiles/{safe_name(tile.id)}/{name}", grid, tile.grid, band)
        xml.endElement("VRTRasterBand")
        xml.endElement("VRTDataset")
    if isinstance(run.path, Path):
        write(run.path / _style_name(kind), encode_style(band), flush)


def _describe(xml: XMLGenerator, band: Band) -> None:
    """Write name, unit, nodata, colours and names of classes."""
    _leaf(xml, "Description", band.name)
    if band.unit:
        _leaf(xml, "UnitType", band.unit)
    if band.nodata is not None:
        _leaf(xml, "NoDataValue", _number(band.nodata))
    if not band.classes:
        _leaf(xml, "ColorInterp", "Gray")
        return
    _leaf(xml, "ColorInterp", "Palette")
    _begin(xml, "CategoryNames")
    for one in band.classes:
        _leaf(xml, "Category", one.name)
    xml.endElement("CategoryNames")
    _begin(xml, "ColorTable")
    for one in band.classes:
        red, green, blue = map(str, one.colour)
        _leaf(xml, "Entry", c1=red, c2=green, c3=blue, c4="255")
    xml.endElement("ColorTable")


def _source(xml: XMLGenerator, name: str, whole: Grid, tile: Grid, band: Band) -> None:
    """Write the entry of one tile; where the tile has nodata, other tiles are visible."""
    kind = "SimpleSource" if band.nodata is None else "ComplexSource"
    size = f'xSize="{tile.width}" ySize="{tile.height}"'
    left, top = round((tile.west - whole.west) / whole.cell), round((whole.north - tile.north) / whole.cell)
    nodata = "" if band.nodata is None else f"<NODATA>{_number(band.nodata)}</NODATA>"
    # Text is several times as fast as single elements. With the properties, GDAL does not open all files when
    # it opens the mosaic.
    xml.ignorableWhitespace(
        f'<{kind}><SourceFilename relativeToVRT="1">{escape(name)}</SourceFilename><SourceBand>1</SourceBand>'
        f'<SourceProperties RasterXSize="{tile.width}" RasterYSize="{tile.height}" '
        f'DataType="{TYPES[band.dtype]}" BlockXSize="{BLOCK}" BlockYSize="{BLOCK}"/>'
        f'<SrcRect xOff="0" yOff="0" {size}/><DstRect xOff="{left}" yOff="{top}" {size}/>{nodata}</{kind}>'
    )


def _begin(xml: XMLGenerator, name: str, **attributes: str) -> None:
    xml.startElement(name, AttributesImpl(attributes))


def _leaf(xml: XMLGenerator, name: str, text: str = "", **attributes: str) -> None:
    _begin(xml, name, **attributes)
    xml.characters(text)
    xml.endElement(name)


def _number(value: float) -> str:
    return "nan" if math.isnan(value) else f"{value:g}"


def write_states(run: Run, where: Location) -> None:
    """Write the tiles as polygons in longitude and latitude (WGS 84, RFC 7946).

    Columns: ``id``; ``state`` (``done``: computed by the last run; ``cached``: done before it; ``failed``;
    ``pending``); ``stale``, whether a failed or pending tile has products of an earlier result;
    ``error``, the reason of a failure; ``seconds``, the computing time; ``error_estimate_m``, the error
    estimate of the surface exported first (m); ``flags``, its flags, such as ``no-road``; ``finished``, the
    time of completion.
    """
    variant = run.config.export.variants[0]
    places, flush = shapely.to_geojson(outlines(run.catalog.tiles)), run.config.cluster.flush
    with open_database(run) as database, atomic_file(where, flush) as local, local.open("w") as file:
        # It is written as a stream, because the features of all tiles take more memory than the catalog.
        file.write('{"type": "FeatureCollection", "features": [')
        rows = zip(recorded(run, database), places, strict=True)
        for number, ((tile_id, state, record), place) in enumerate(rows):
            feature = _feature(tile_id, state, record, variant, place)
            file.write(f"{', ' if number else ''}{json.dumps(feature)}")
        file.write("]}")


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
    # Coordinates beyond the range of a CRS become infinite.
    return np.where(
        shapely.is_valid(shapes), shapely.transform(shapes, lambda degrees: degrees.round(7)), None
    )


def _feature(
    tile_id: str, state: TileState, record: TileRecord | None, variant: str, outline: str | None
) -> dict[str, Any]:
    stale = state in ("failed", "pending") and record is not None and record.has_products
    row: dict[str, Any] = dict.fromkeys(MAP_COLUMNS) | {"id": tile_id, "state": state, "stale": stale}
    # The record of a pending tile belongs to earlier files or options.
    if record is not None and state != "pending":
        row |= {"seconds": round(record.seconds, 3), "finished": record.finished or None}
        if record.failures:
            row["error"] = record.failures[0].line
        for metrics in record.rows:
            if metrics["variant"] == variant:
                row["error_estimate_m"] = metrics.get("error_estimate_m")
                row["flags"] = metrics.get("flags") or None
    geometry = json.loads(outline) if outline else None
    return {"id": tile_id, "type": "Feature", "properties": row, "geometry": geometry}
