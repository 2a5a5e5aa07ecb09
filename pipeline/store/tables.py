"""The run's tables: fixed columns, one row per (tile, variant), one row per failure."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import fields
from itertools import islice

import pandas as pd

from flexroad.catalog.storage.paths import Location, exists, read
from flexroad.catalog.storage.staging import atomic_file
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.store.records import Failure, MetricsRow

METRICS, PREVIOUS = "metrics.parquet", "metrics.previous.parquet"
"""Tables of a run, and before its last execution."""
CHUNK = 10_000
"""Rows held in memory at a time; also the row groups of metrics.parquet."""

COLUMNS: dict[str, str] = {
    "tile_id": "str",
    "variant": "str",
    "method": "str",
    "stratum": "str",
    "status": "str",
    "l2_road_m": "float64",
    "l2_terrain_m": "float64",
    "rmse_road_m": "float64",
    "rmse_terrain_m": "float64",
    "nmad_road_m": "float64",
    "p95_road_m": "float64",
    "mad_road_deg": "float64",
    "mad_terrain_deg": "float64",
    "triangles": "Int64",
    "road_fraction": "float64",
    "completeness": "float64",
    "seconds": "float64",
    "error": "str",
    "nearest_road_m": "float64",
    "nearest_terrain_m": "float64",
    "residual_median_m": "float64",
    "residual_nmad_m": "float64",
    "residual_p95_m": "float64",
    "curvature_per_m": "float64",
    "edge_step_m": "float64",
    "measured_road": "float64",
    "dtm_road": "float64",
    "inferred_road": "float64",
    "dropped_road": "float64",
    "off_dtm_m": "float64",
    "off_dtm_road": "float64",
    "bounded_weights": "float64",
    "error_estimate_m": "float64",
    "suspect_m2": "float64",
    "flags": "str",
}
"""Columns of metrics.parquet and their types, in the table's order."""


def metrics_frame(rows: Sequence[MetricsRow]) -> pd.DataFrame:
    """Return the rows as a table with the columns of metrics.parquet."""
    frame = pd.DataFrame(list(rows), columns=list(COLUMNS))
    return frame.astype(COLUMNS)


def write_tables(
    run: Location, rows: Iterable[MetricsRow], failures: Iterable[Failure], flushed: bool = False
) -> None:
    """Write metrics.parquet and failures.csv in chunks.

    With ``flushed`` their contents are on the disk before they replace the old tables.

    Raises
    ------
    OSError
        If they cannot be written, for example on a full disk.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    schema = pa.Table.from_pandas(metrics_frame([]), preserve_index=False).schema
    with (
        atomic_file(run / METRICS, flushed) as path,
        pq.ParquetWriter(path, schema, write_page_checksum=True) as table,
    ):
        for chunk in _chunks(rows):
            table.write_table(pa.Table.from_pandas(metrics_frame(chunk), schema, preserve_index=False))
    names = [field.name for field in fields(Failure) if field.name != "trace"]
    with atomic_file(run / "failures.csv", flushed) as path, path.open("w", newline="") as file:
        lines = csv.writer(file, lineterminator="\n")
        lines.writerow(names)
        lines.writerows([getattr(failure, name) for name in names] for failure in failures)


def _chunks(rows: Iterable[MetricsRow]) -> Iterator[list[MetricsRow]]:
    remaining = iter(rows)
    while chunk := list(islice(remaining, CHUNK)):
        yield chunk


def read_metrics(run: Location, name: str = METRICS) -> pd.DataFrame:
    """Read the rows of a run.

    Parameters
    ----------
    run : Location
    name : str
        File in the folder of the run.

    Raises
    ------
    ConfigError
        If the table does not exist yet or is damaged.
    """
    path = run / name
    if not exists(path):
        raise ConfigError(f"{path} does not exist; `flexroad rerun {run}` finishes the run")
    try:
        frame = frame_of(read(path))
        if unknown := set(frame.columns) - set(COLUMNS):
            raise ValueError(f"it has the columns {', '.join(map(repr, sorted(unknown, key=repr)))}")
        # Tables of older versions lack the newer columns.
        return frame.reindex(columns=list(COLUMNS))
    except (OSError, ValueError, KeyError, TypeError) as error:
        remedy = f"`flexroad rerun {run}` writes it again" if name == METRICS else "remove it"
        raise ConfigError(f"{path} is damaged: {error}; {remedy}") from error


def frame_of(data: bytes) -> pd.DataFrame:
    """Return the table in the bytes of a Parquet file.

    Raises
    ------
    OSError, ValueError
        If they are not a Parquet file.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    # pandas.read_parquet starts threads; those still running when a short command exits can abort it.
    file = pq.ParquetFile(pa.BufferReader(data), pre_buffer=False, page_checksum_verification=True)
    table: pd.DataFrame = file.read(use_threads=False).to_pandas(use_threads=False)
    return table
