"""FlatGeobuf: GDAL copies the features as a stream of tables, in which the geometries get heights."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from flexroad.catalog.guard.open_vector import ERRORS, vector_name
from flexroad.catalog.lazy import lazy
from flexroad.catalog.text import reason
from flexroad.tasks.errors import TaskError
from flexroad.tools.lift.features import (
    BATCH_BYTES,
    BATCH_FEATURES,
    COLUMNS,
    Feature,
    level_columns,
    lifted,
    percent_columns,
    vector_info,
    wanted_levels,
    with_zero,
)
from flexroad.tools.lift.shapes import COLLECTION, NAMES, POINT, of_wkb, to_wkb
from flexroad.tools.lift.types import Frame, Lifted, Options, RunSurface

pyogrio = lazy("pyogrio")
if TYPE_CHECKING:
    import pyarrow as pa
else:
    pa = lazy("pyarrow")

SUFFIXES = (".fgb",)
KINDS = NAMES[POINT : COLLECTION + 1]
"""Types of layers that GDAL writes with z; it does not write z for layers of several types."""


def frame(source: Path) -> Frame:
    """Return the CRS in the header."""
    return Frame(vector_info(source)["crs"])


def lift(source: Path, out: Path, run: RunSurface, options: Options) -> Iterator[Lifted]:
    """Copy a file with heights; yield the rows of the report."""
    info, rows, failures = vector_info(source), list[Lifted](), list[Exception]()
    kind = info["geometry_type"]
    if kind not in KINDS and kind.removesuffix(" Z") not in KINDS:
        raise TaskError(
            f"has geometries of the type {kind}, which GDAL does not write with heights; convert it with "
            "ogr2ogr NEW.gpkg FILE"
        )
    size = source.stat().st_size // max(info["features"], 1)
    batch = max(1, min(BATCH_FEATURES, BATCH_BYTES // max(size, 1)))
    try:
        name = vector_name(source)
        with (
            _general_reader(),
            warnings.catch_warnings(),
            pyogrio.raw.open_arrow(name, use_pyarrow=True, batch_size=batch, return_fids=False) as opened,
        ):
            warnings.filterwarnings("ignore", "'crs' was not provided")
            geometry, reader = opened[0]["geometry_name"] or "wkb_geometry", opened[1]
            schema = reader.schema
            for column in COLUMNS if options.columns else ():
                new, at = pa.field(column, pa.float64()), schema.get_field_index(column)
                schema = schema.append(new) if at < 0 else schema.set(at, new)
            tables = _lifted_tables(reader, schema, geometry, run, options, rows, failures)
            metadata = info["layer_metadata"] or {}
            pyogrio.raw.write_arrow(
                pa.RecordBatchReader.from_batches(schema, tables),
                out,
                layer=info["layer_name"],
                driver="FlatGeobuf",
                geometry_name=geometry,
                geometry_type=kind.removesuffix(" Z") + " Z",
                crs=info["crs"],
                # Without an index the features keep their order; else they get the order of the index.
                SPATIAL_INDEX="YES" if info["capabilities"]["fast_spatial_filter"] else "NO",
                **{key: metadata[key] for key in ("TITLE", "DESCRIPTION") if key in metadata},
            )
    except ERRORS as error:
        if failures:
            # The stream of tables passes on only its text.
            raise failures[0] from error
        raise TaskError(f"cannot be copied: {reason(error)}") from error
    if len(rows) < info["features"]:
        raise TaskError(f"is cut off: it has {len(rows)} of {info['features']} features; copy it again")
    yield from rows


@contextmanager
def _general_reader() -> Iterator[None]:
    """Use GDAL's general reader of tables: the reader for FlatGeobuf fails at features without geometry."""
    option = "OGR_FLATGEOBUF_STREAM_BASE_IMPL"
    before = pyogrio.get_gdal_config_option(option)
    pyogrio.set_gdal_config_options({option: True})
    try:
        yield
    finally:
        pyogrio.set_gdal_config_options({option: before})


def _lifted_tables(
    reader: Any,
    schema: pa.Schema,
    geometry: str,
    run: RunSurface,
    options: Options,
    rows: list[Lifted],
    failures: list[Exception],
) -> Iterator[pa.RecordBatch]:
    """Yield the batches of a file with heights; append their rows, and an error that ends the file."""
    try:
        for batch in reader:
            columns = {name: batch.column(name) for name in batch.schema.names}
            wkb, own = list[bytes | None](), list[Lifted]()
            for shape, row in lifted(_features(columns, geometry, len(rows)), run, options):
                shape, row = with_zero(shape, row)
                wkb.append(None if shape is None else to_wkb(shape))
                own.append(row)
            rows += own
            columns[geometry] = pa.array(wkb, schema.field(geometry).type)
            if options.columns:
                values = zip(*map(percent_columns, own), strict=True)
                columns |= {
                    name: pa.array(part, pa.float64()) for name, part in zip(COLUMNS, values, strict=True)
                }
            yield pa.RecordBatch.from_arrays([columns[name] for name in schema.names], schema=schema)
    except Exception as error:
        failures.append(error)
        raise


def _features(columns: dict[str, Any], geometry: str, first: int) -> list[Feature]:
    levels = {name: columns[name].to_pylist() for name in level_columns(columns) if name != geometry}
    shapes = columns[geometry].to_pylist()
    features = []
    for number, (data, level) in enumerate(
        zip(shapes, wanted_levels(levels, len(shapes)), strict=True), first
    ):
        try:
            features.append(Feature(str(number), None if data is None else of_wkb(data), level))
        except TaskError as error:
            raise TaskError(f"(feature {number}) {error}") from error
    return features
