"""Damage of metrics.parquet is an error: no figure changes."""

import csv
import io
import random

import pandas as pd
import pytest

from flexroad.catalog.text import with_formula
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.store.records import Failure
from flexroad.pipeline.store.tables import COLUMNS, csv_text, read_metrics, write_tables

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


FORMULAS = ["=1+1", "+cmd|' /C calc'!A0", "-2+3", "@SUM(1)", "\t=1", "\n=1"]
PLAIN = ["", "a=1", "'quoted'", "-5", "+1.5e-3", "-81%", "-500_5600", "-1,5", "1-2", "-81% to -79%", "é"]


def test_texts_that_are_formulas_get_an_apostrophe_in_csv(tmp_path):
    texts = FORMULAS + PLAIN
    table = pd.DataFrame({"=text": texts, "number": [-1.5] * len(texts), "count": [-2] * len(texts)})
    table["mixed"] = pd.Series([None, "=1", *[-3.0] * (len(texts) - 2)], dtype=object)
    before = table.copy()
    rows = list(csv.reader(io.StringIO(csv_text(table, float_format="%.9g"), newline="")))
    assert rows[0] == ["'=text", "number", "count", "mixed"]
    assert [row[0] for row in rows[1:]] == [f"'{text}" for text in FORMULAS] + PLAIN
    assert {tuple(row[1:3]) for row in rows[1:]} == {("-1.5", "-2")}
    assert [row[3] for row in rows[1:4]] == ["", "'=1", "-3.0"]
    pd.testing.assert_frame_equal(table, before)
    # Outside quotes a line break would begin a new row.
    assert csv_text(pd.DataFrame({"a": ["x\r=1", "\r\n=1"]})) == 'a\n"x\n=1"\n"\'\n=1"\n'
    assert [with_formula(row[0]) for row in rows[1:]] == texts
    write_tables(tmp_path, [], [Failure("=1", "load", "TaskError", "@message", "-file")])
    with (tmp_path / "failures.csv").open(newline="") as file:
        assert list(csv.reader(file))[1] == ["'=1", "load", "TaskError", "'@message", "'-file"]


def test_levels_have_a_table_of_their_own_while_tiles_have_some(tmp_path):
    tile = {"tile_id": "=a", "variant": "flexroad", "status": "done"}
    levels = [
        {"level": 1, "area_m2": 160.0, "flags": "below, no-rise"},
        {"level": 2, "area_m2": 9.5, "flags": ""},
    ]
    write_tables(tmp_path, [{**tile, "levels": levels}, {**tile, "tile_id": "b"}], [])
    lines = (tmp_path / "levels.csv").read_text().splitlines()
    assert lines == [
        "tile_id,variant,level,area_m2,flags",
        '\'=a,flexroad,1,160.0,"below, no-rise"',
        "'=a,flexroad,2,9.5,",
    ]
    assert read_metrics(tmp_path).tile_id.tolist() == ["=a", "b"]
    write_tables(tmp_path, [tile], [])
    assert not (tmp_path / "levels.csv").exists()


@pytest.mark.parametrize(
    ("column", "reason"),
    [("tile_id", ".*'variant'.*not in index"), ("tile_ie", "it has the columns 'tile_ie'")],
)
def test_read_metrics_missing_or_unknown_column_raises(tmp_path, column, reason):
    pd.DataFrame({column: ["a"]}).to_parquet(tmp_path / "metrics.parquet")
    with pytest.raises(ConfigError, match=f"is damaged: {reason}.*flexroad rerun"):
        read_metrics(tmp_path)
