"""The run's tables with fixed columns: one row per (tile, variant), and one row per failure."""

from __future__ import annotations

import csv
import json
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import fields
from itertools import islice
from typing import TYPE_CHECKING, Any

from flexroad.catalog.lazy import lazy
from flexroad.catalog.storage.buckets import atomic_file
from flexroad.catalog.storage.paths import Location, exists, read, remove
from flexroad.catalog.text import access_reason, no_formula
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.store.records import LEVELS, Failure, MetricsRow

if TYPE_CHECKING:
    import pandas as pd

pandas = lazy("pandas")
pyarrow = lazy("pyarrow")

METRICS, PREVIOUS = "metrics.parquet", "metrics.previous.parquet"
"""Metrics of a run, and its metrics before the last execution."""
OF_LEVELS = "levels.csv"
"""Figures of decks and tunnels: a row per tile, variant and level."""
CHUNK = 10_000
"""Number of rows in memory at a time, and in a row group of metrics.parquet."""

TEXTS = "tile_id variant method stratum status error flags".split()
NAMES = """
    tile_id variant method stratum status l2_road_m l2_terrain_m rmse_road_m rmse_terrain_m nmad_road_m
    p95_road_m mad_road_deg mad_terrain_deg triangles road_fraction completeness seconds error
    nearest_road_m nearest_terrain_m mesh_p95_road_m mesh_max_road_m mesh_p95_terrain_m
    mesh_max_terrain_m residual_median_m residual_nmad_m residual_p95_m curvature_per_m edge_step_m
    measured_road dtm_road inferred_road dropped_road dsm_excess_m off_dtm_m off_dtm_road
    bounded_weights error_estimate_m worst_error_estimate_m worst_easting worst_northing
    max_unexplained_area_m2 holdout_squares holdout_error_m holdout_covered flags
""".split()
COLUMNS = dict.fromkeys(NAMES, "float64") | dict.fromkeys(TEXTS, "str") | {"triangles": "Int64"}
"""Columns of metrics.parquet and their types in pandas, in the table's order."""
LABELS: dict[str, tuple[str, str]] = {
    "error_estimate_m": ("error estimate", "m"),
    "worst_error_estimate_m": ("error estimate of the worst 25 m²", "m"),
    "l2_road_m": ("road error (L2)", "m"),
    "p95_road_m": ("road error, 95th percentile", "m"),
    "rmse_road_m": ("road error (RMSE)", "m"),
    "nmad_road_m": ("road error (NMAD)", "m"),
    "l2_terrain_m": ("terrain error (L2)", "m"),
    "rmse_terrain_m": ("terrain error (RMSE)", "m"),
    "nearest_road_m": ("road error in 3D", "m"),
    "nearest_terrain_m": ("terrain error in 3D", "m"),
    "mad_road_deg": ("roughness of the road (MAD)", "°"),
    "mad_terrain_deg": ("roughness of the terrain (MAD)", "°"),
    "mesh_p95_road_m": ("mesh distance road p95", "m"),
    "mesh_max_road_m": ("mesh distance road, largest", "m"),
    "mesh_p95_terrain_m": ("mesh distance terrain p95", "m"),
    "mesh_max_terrain_m": ("mesh distance terrain, largest", "m"),
    "max_unexplained_area_m2": ("largest unexplained patch", "m²"),
    "curvature_per_m": ("largest curvature", "1/m"),
    "edge_step_m": ("step at the road's edge", "m"),
    "residual_median_m": ("surface minus the road's heights, median", "m"),
    "residual_nmad_m": ("surface minus the road's heights, NMAD", "m"),
    "residual_p95_m": ("surface minus the road's heights, 95th percentile", "m"),
    "dsm_excess_m": ("DSM above the heights that roads are fitted to, median", "m"),
    "off_dtm_m": ("surface minus DTM, median", "m"),
    "off_dtm_road": ("road off the DTM", "%"),
    "measured_road": ("road with a measured height", "%"),
    "dtm_road": ("road with the DTM's height", "%"),
    "inferred_road": ("road without a height", "%"),
    "dropped_road": ("road dropped by the filter", "%"),
    "bounded_weights": ("weights at their limit", "%"),
    "holdout_squares": ("withheld squares of road", ""),
    "holdout_error_m": ("mean difference at withheld squares", "m"),
    "holdout_covered": ("withheld squares within the 90% interval", "%"),
    "road_fraction": ("share of road", "%"),
    "completeness": ("completeness", "%"),
    "triangles": ("triangles", ""),
    "seconds": ("computing time", "s"),
}
"""Label and unit of the numeric columns of metrics.parquet, for report and viewer; shares are in percent."""
IN_ARROW = {"str": "large_string", "float64": "float64", "Int64": "int64"}
"""Type in Arrow by type in pandas."""


def _schema() -> Any:
    """Return the schema of metrics.parquet, with the types in pandas.

    It is made without pandas, which would take a quarter of the start of a run.
    """
    described = [
        {
            "name": name,
            "field_name": name,
            "pandas_type": "object" if kind == "str" else IN_ARROW[kind],
            "numpy_type": kind,
            "metadata": None,
        }
        for name, kind in COLUMNS.items()
    ]
    about = {"index_columns": [], "column_indexes": [], "columns": described, "pandas_version": "3.0.0"}
    names = ((name, pyarrow.type_for_alias(IN_ARROW[kind])) for name, kind in COLUMNS.items())
    return pyarrow.schema(names, {"pandas": json.dumps(about)})


def write_tables(
    run: Location, rows: Iterable[MetricsRow], failures: Iterable[Failure], flushed: bool = False
) -> None:
    """Write metrics.parquet and failures.csv in chunks, and levels.csv if a tile has decks or tunnels.

    With ``flushed`` their contents are on the disk before they replace the old tables.
    """
    schema, of_levels = _schema(), list[dict[str, Any]]()
    with (
        atomic_file(run / METRICS, flushed) as path,
        pyarrow.parquet.ParquetWriter(path, schema, write_page_checksum=True) as table,
    ):
        for chunk in _chunks(rows):
            table.write_table(_table(chunk, schema))
            of_levels += level_rows(chunk)
    names = [field.name for field in fields(Failure) if field.name != "trace"]
    values = ([getattr(failure, name) for name in names] for failure in failures)
    _write_csv(run / "failures.csv", names, values, flushed)
    if of_levels:
        _write_csv(run / OF_LEVELS, list(of_levels[0]), (row.values() for row in of_levels), flushed)
    elif exists(run / OF_LEVELS):
        remove(run / OF_LEVELS)


def level_rows(rows: Iterable[MetricsRow]) -> list[dict[str, Any]]:
    """Return the figures of the decks and tunnels in the rows of tiles, with tile and variant."""
    return [
        {"tile_id": row["tile_id"], "variant": row["variant"], **level}
        for row in rows
        for level in row.get(LEVELS, ())
    ]


def _write_csv(path: Location, names: Sequence[str], rows: Iterable[Iterable[Any]], flushed: bool) -> None:
    with atomic_file(path, flushed) as written, written.open("w", newline="") as file:
        lines = csv.writer(file, lineterminator="\n")
        lines.writerow(names)
        lines.writerows([no_formula(value) for value in row] for row in rows)


def csv_text(table: pd.DataFrame, **options: Any) -> str:
    """Return a table as CSV in which no text is a formula (`no_formula`); ``options`` go to pandas."""
    safe = table.set_axis([no_formula(name) for name in table.columns], axis="columns")
    for number, kind in enumerate(table.dtypes):
        if not pandas.api.types.is_numeric_dtype(kind):
            safe.isetitem(number, [no_formula(value) for value in table.iloc[:, number]])
    return str(safe.to_csv(index=False, **options))


def _table(rows: Sequence[MetricsRow], schema: Any) -> Any:
    """Return rows as a table. They pass through JSON, because pyarrow imports pandas for Python objects."""
    lines = "\n".join(json.dumps(row, allow_nan=False) for row in rows).encode()
    table = pyarrow.json.read_json(
        pyarrow.BufferReader(lines),
        # Reader threads may still be alive when a short process ends, and would abort it.
        pyarrow.json.ReadOptions(use_threads=False, block_size=len(lines) + 1),
        pyarrow.json.ParseOptions(explicit_schema=schema, unexpected_field_behavior="ignore"),
    )
    # The columns already have these types, and a cast would import pyarrow.compute.
    return table.replace_schema_metadata(schema.metadata)


def metrics_frame(rows: Sequence[MetricsRow]) -> pd.DataFrame:
    """Return the rows as a table with the columns of metrics.parquet."""
    frame: pd.DataFrame = pandas.DataFrame(list(rows), columns=list(COLUMNS))
    return frame.astype(COLUMNS)


def _chunks(rows: Iterable[MetricsRow]) -> Iterator[list[MetricsRow]]:
    remaining = iter(rows)
    while chunk := list(islice(remaining, CHUNK)):
        yield chunk


def read_metrics(run: Location, name: str = METRICS) -> pd.DataFrame:
    """Read the rows of a run."""
    path = run / name
    if not exists(path):
        raise ConfigError(f"{path} does not exist; `flexroad rerun {run}` finishes the run")
    try:
        frame = frame_of(read(path))
        if unknown := set(frame.columns) - set(COLUMNS):
            raise ValueError(f"it has the columns {', '.join(map(repr, sorted(unknown, key=repr)))}")
        return frame[list(COLUMNS)]
    except (OSError, ValueError, KeyError, TypeError, NotImplementedError) as error:
        if why := access_reason(error):
            raise ConfigError(f"{path} {why}") from error
        remedy = f"`flexroad rerun {run}` writes it again" if name == METRICS else "remove it"
        raise ConfigError(f"{path} is damaged: {error}; {remedy}") from error


def frame_of(data: bytes) -> pd.DataFrame:
    """Return the table in the bytes of a Parquet file."""
    # pandas.read_parquet starts threads; those still running when a short command exits can abort it.
    file = pyarrow.parquet.ParquetFile(
        pyarrow.BufferReader(data), pre_buffer=False, page_checksum_verification=True
    )
    table: pd.DataFrame = file.read(use_threads=False).to_pandas(use_threads=False)
    return table
