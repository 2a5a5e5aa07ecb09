"""Catalogs as GeoParquet, in the layout of stac-geoparquet: reading and writing of rows."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Sequence
from datetime import UTC, datetime, timedelta
from itertools import islice, pairwise, repeat
from typing import Any

import numpy as np
import shapely

from flexroad.catalog.lazy import lazy

pa = lazy("pyarrow")
pq = lazy("pyarrow.parquet")
pyproj = lazy("pyproj")

Item = dict[str, Any]
EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
AT_ONCE = 1000
"""Number of rows that are converted to objects at a time: objects take many times the memory of a table."""
GROUP = 10_000
"""Rows of a row group, which stays in memory until it is written; a multiple of `AT_ONCE`."""
MAX_ROWS = 10_000_000
MAX_UNPACKED = 8 * 2**30
"""Most rows and bytes of a table, unpacked; ten million tiles of 250 m are 625,000 km2."""


SKIPPED = "flexroad:skipped"
"""Key of the list of skipped files in the metadata of a table, and in a feature collection."""
EDGES = ("xmin", "ymin", "xmax", "ymax")


class Unreadable:
    """A value that cannot be read: no field of an entry accepts it."""

    def __init__(self, reason: str) -> None:
        self.reason = reason

    def __repr__(self) -> str:
        return f"<{self.reason}>"


FIELDS = tuple(
    f".flexroad:{name}" for name in ("files", "values", "crs", "reproject", "sublayer", "height_unit")
)
"""Fields of an asset from which a layer is made, without its extents."""


def entries(data: bytes) -> tuple[Iterator[Item], Any]:
    """Return the fields of each item from which a tile is made, and the entries of skipped files.

    Reading complete items is many times slower.
    """
    file = pq.ParquetFile(pa.BufferReader(data), pre_buffer=False, page_checksum_verification=True)
    metadata = file.metadata
    # A few kilobytes can unpack to any size.
    unpacked = sum(metadata.row_group(number).total_byte_size for number in range(metadata.num_row_groups))
    if metadata.num_rows > MAX_ROWS or unpacked > MAX_UNPACKED:
        raise ValueError(f"it has {metadata.num_rows:,} rows, which unpack to {unpacked / 2**30:,.1f} GiB")
    paths = (file.schema.column(number).path.split(".") for number in range(len(file.schema)))
    columns = dict.fromkeys(".".join(path[:3] if path[0] == "assets" else path[:1]) for path in paths)
    plain = [name for name in columns if name.startswith(("id", "proj:", "flexroad:", "datetime"))]
    plain += [name for name in columns if name.startswith("assets.") and name.endswith(FIELDS)]
    names = [name for name in columns if name.endswith(".flexroad:extents")]
    skipped = (metadata.metadata or {}).get(SKIPPED.encode(), b"[]")
    return _rows(file, plain, names), json.loads(skipped)


def _rows(file: Any, plain: list[str], names: list[str]) -> Iterator[Item]:
    """Yield the fields of each row. Only a part of the rows is in memory at a time."""
    # Reader threads may still be alive when a short process ends, and would abort it.
    parts = file.iter_batches(AT_ONCE, columns=plain, use_threads=False)
    extents = file.iter_batches(AT_ONCE, columns=names, use_threads=False) if names else repeat(None)
    for part, assets in zip(parts, extents, strict=False):
        rows = _values(pa.Table.from_batches([part]))
        for field in assets["assets"].type if assets else ():
            _add_extents(rows, field.name, assets["assets"].field(field.name).field("flexroad:extents"))
        for row in rows:
            yield {name: row[name] for name in ("id", "assets") if name in row} | {"properties": row}


def _values(table: Any) -> list[Item]:
    dates = [name for name in table.column_names if str(table[name].type).startswith("timestamp")]
    try:
        rows: list[Item] = table.drop_columns(dates).to_pylist()
        for name in dates:
            for row, date in zip(rows, _dates(table[name]), strict=True):
                row[name] = date
    except Exception:
        # Dates out of range, or text that is not UTF-8: only the entries that have them are lost.
        columns = {name: table[name] for name in table.column_names}
        return [{name: _value(columns[name], n) for name in columns} for n in range(table.num_rows)]
    return rows


def _dates(column: Any) -> Iterator[datetime | None]:
    """Yield the dates of a column of timestamps. pyarrow would import pandas for them, which is slow."""
    per_second = {"s": 1, "ms": 10**3, "us": 10**6, "ns": 10**9}[column.type.unit]
    for chunk in column.chunks:
        for number in chunk.view(pa.int64()).to_pylist():
            yield None if number is None else EPOCH + timedelta(microseconds=number * 10**6 // per_second)


def _value(column: Any, number: int) -> Any:
    try:
        return column[number].as_py()
    except Exception as error:
        return Unreadable(str(error))


def _add_extents(rows: list[Item], name: str, column: Any) -> None:
    """Add the extents to an asset of each row, as arrays: lists of numbers take several times as long."""
    try:
        # `to_numpy` would import pandas.
        ends, edges = column.offsets.to_pylist(), np.from_dlpack(column.values)
        found = [edges[a:b] if a < b else None for a, b in pairwise(ends)]
    except Exception:
        # They are not lists of numbers, or have gaps.
        found = [_value(column, number) for number in range(len(column))]
    for row, extents in zip(rows, found, strict=True):
        assets = row.get("assets")
        asset = assets.get(name) if isinstance(assets, dict) else None
        if extents is not None and isinstance(asset, dict):
            asset["flexroad:extents"] = extents


def schema_of(full: Item) -> Any:
    """Return the columns of a table of items, inferred from an item with all fields."""
    schema = pa.Table.from_pylist([row(full)]).schema
    number = schema.get_field_index("geometry")
    outlines = pyproj.CRS.from_epsg(4326).to_json_dict()
    metadata = {
        "ARROW:extension:name": "geoarrow.wkb",
        "ARROW:extension:metadata": json.dumps({"crs": outlines}, separators=(",", ":")),
    }
    return schema.set(number, schema.field(number).with_metadata(metadata))


def table_bytes(items: Iterable[Item], schema: Any, skipped: Sequence[Item] = ()) -> bytes:
    """Return a table of items as GeoParquet 1.1, as stac-geoparquet writes it.

    Its import takes an eighth of the time of a run with nothing to do. Its conversion is many times slower.
    """
    outlines = pyproj.CRS.from_epsg(4326).to_json_dict()
    column = {"encoding": "WKB", "geometry_types": [], "crs": outlines, "edges": "planar"}
    column["covering"] = {"bbox": {name: ["bbox", name] for name in EDGES}}
    geo = {"version": "1.1.0", "columns": {"geometry": column}, "primary_column": "geometry"}
    metadata = {"geo": json.dumps(geo), "stac-geoparquet": json.dumps({"version": "1.0.0"})}
    metadata |= {SKIPPED: json.dumps(list(skipped))} if skipped else {}
    schema, rows, written = schema.with_metadata(metadata), map(row, items), pa.BufferOutputStream()
    with pq.ParquetWriter(written, schema, write_page_checksum=True) as writer:
        while group := list(_tables(islice(rows, GROUP), schema)):
            for batch in pa.concat_tables(group).combine_chunks().to_batches():
                writer.write_batch(batch)
    return bytes(written.getvalue())


def _tables(rows: Iterator[Item], schema: Any) -> Iterator[Any]:
    while part := list(islice(rows, AT_ONCE)):
        yield pa.Table.from_pylist(part, schema)


def row(item: Item) -> Item:
    """Return an item as a table row: properties as columns, the outline as WKB."""
    values: Item = {name: value for name, value in item.items() if name != "properties"} | item["properties"]
    values["datetime"] = datetime.fromisoformat(item["properties"]["datetime"])
    if item["geometry"]:
        (ring,) = item["geometry"]["coordinates"]
        values["geometry"] = shapely.to_wkb(shapely.Polygon(ring))
        values["bbox"] = dict(zip(EDGES, item["bbox"], strict=True))
    return values
