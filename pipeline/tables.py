"""The run's tables: fixed columns, one row per (tile, variant), one row per failure."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import pandas as pd

from pipeline.errors import ConfigError
from pipeline.store import write_atomic
from pipeline.work import Failure

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
    "doubt_m": "float64",
    "doubted_m2": "float64",
    "flags": "str",
}
"""Columns of metrics.parquet and their types; the fixed ones first."""


def metrics_frame(rows: Sequence[dict[str, Any]]) -> pd.DataFrame:
    """Return the rows as a table with the fixed columns."""
    frame = pd.DataFrame(list(rows), columns=list(COLUMNS))
    return frame.astype(COLUMNS)


def write_tables(run: Path, rows: Sequence[dict[str, Any]], failures: Sequence[Failure]) -> None:
    """Write metrics.parquet and failures.csv."""
    buffer = io.BytesIO()
    metrics_frame(rows).to_parquet(buffer, index=False)
    write_atomic(run / "metrics.parquet", buffer.getvalue())
    names = [field.name for field in fields(Failure) if field.name != "trace"]
    table = pd.DataFrame([asdict(failure) for failure in failures], columns=names)
    write_atomic(run / "failures.csv", table.to_csv(index=False).encode())


def read_metrics(run: Path) -> pd.DataFrame:
    """Read the rows of a run.

    Raises
    ------
    ConfigError
        If there are none yet, or the table is damaged.
    """
    path = run / "metrics.parquet"
    if not path.exists():
        raise ConfigError(f"{path} does not exist; `flexroad rerun {run}` finishes the run")
    try:
        # Runs of earlier days lack the later columns.
        return pd.read_parquet(path).reindex(columns=list(COLUMNS))
    except (OSError, ValueError) as error:
        raise ConfigError(f"{path} is damaged: {error}; `flexroad rerun {run}` writes it anew") from error
