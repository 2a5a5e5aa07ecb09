"""Damage of metrics.parquet is an error: no figure changes."""

import random

import pandas as pd
import pytest

from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.store.tables import COLUMNS, read_metrics, write_tables

VALUES = {"str": "done", "float64": 0.028, "Int64": 7}


def test_read_metrics_damaged_byte_raises_or_changes_nothing(tmp_path):
    rng = random.Random(1)
    rows = [
        {name: rng.random() if kind == "float64" else VALUES[kind] for name, kind in COLUMNS.items()}
        for _ in range(40)
    ]
    write_tables(tmp_path, rows, [])
    path = tmp_path / "metrics.parquet"
    whole, expected = path.read_bytes(), read_metrics(tmp_path)
    refused = 0
    for _ in range(300):
        damaged = bytearray(whole)
        damaged[rng.randrange(len(damaged))] ^= 1 << rng.randrange(8)
        path.write_bytes(damaged)
        try:
            table = read_metrics(tmp_path)
        except ConfigError:
            refused += 1
        else:
            pd.testing.assert_frame_equal(table, expected, check_exact=True)
    assert refused > 150


def test_read_metrics_of_earlier_version_lacks_columns(tmp_path):
    table = pd.DataFrame({"tile_id": ["a"], "l2_road_m": [0.028]})
    table.to_parquet(tmp_path / "metrics.parquet")
    read = read_metrics(tmp_path)
    assert list(read.columns) == list(COLUMNS)
    assert (read.l2_road_m[0], read.l2_terrain_m.isna().all()) == (0.028, True)


def test_read_metrics_unknown_column_raises(tmp_path):
    pd.DataFrame({"tile_ie": ["a"]}).to_parquet(tmp_path / "metrics.parquet")
    with pytest.raises(ConfigError, match=r"is damaged: it has the columns 'tile_ie'.*flexroad rerun"):
        read_metrics(tmp_path)
