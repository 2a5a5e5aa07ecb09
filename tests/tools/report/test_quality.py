"""The report's tables of error estimates, height source and flags."""

import numpy as np
import pandas as pd
import pytest
import rasterio
import yaml

from flexroad.catalog import Catalog
from flexroad.pipeline.config.loading import load_config
from flexroad.pipeline.execute import SerialExecutor
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.run.runner import run_tiles
from flexroad.pipeline.store.tables import COLUMNS, metrics_frame, read_metrics
from flexroad.tasks.quality.height_source import HeightSource
from flexroad.tools.report.content import (
    HELD_OUT,
    WORST_ESTIMATES,
    gather,
    held_out,
    highest_error_estimates,
    over_tiles,
)


def rows(error_estimates, flags=()) -> pd.DataFrame:
    """Return one row per error estimate (m); flags by row."""
    records = [
        {
            "tile_id": f"t{i}",
            "variant": "flexroad",
            "status": "done",
            "error_estimate_m": estimate,
            "off_dtm_road": 0.25,
        }
        for i, estimate in enumerate(error_estimates)
    ]
    for row, flag in zip(records, flags, strict=False):
        row["flags"] = flag
    return metrics_frame(records)


def test_highest_error_estimates_are_sorted_and_without_nan():
    metrics = rows([0.1, np.nan, 0.3, 0.2], ["", "no-road", "error-estimate, patch", ""])
    table = highest_error_estimates(metrics, "flexroad", 2)
    assert list(table.tile) == ["t2", "t3"]
    assert list(table["flags"]) == ["error-estimate, patch", "–"]
    assert list(table["off the DTM (%)"]) == [25, 25]


def test_over_tiles_gives_means_and_counts_flagged_tiles():
    metrics = rows([0.1, 0.2, 0.6, np.nan], ["", "spike", "error-estimate", "no-road"])
    row = over_tiles(metrics, ["flexroad"]).iloc[0]
    assert row["error estimate (m)"] == pytest.approx(0.3)
    assert row["flagged tiles"] == 2


def test_held_out_weighs_tiles_by_their_squares():
    metrics = rows([0.1, 0.2, 0.3])
    metrics["holdout_squares"] = [10.0, 30.0, np.nan]
    metrics["holdout_error_m"] = [0.01, 0.03, np.nan]
    metrics["holdout_covered"] = [1.0, 0.8, np.nan]
    row = held_out(metrics, ["flexroad"]).iloc[0]
    assert row["withheld squares"] == 40
    assert row["mean difference (m)"] == pytest.approx(0.025)
    assert row["within the 90% interval (%)"] == pytest.approx(85)
    assert held_out(rows([0.1]), ["flexroad"]).empty


def test_run_with_holdout_fits_twice_and_reports_its_squares(survey, tmp_path, executor):
    options = {"extends": "production", "assess": {"holdout": 0.5}}
    (tmp_path / "held.yaml").write_text(yaml.safe_dump(options))
    run = Run.create(tmp_path / "run", load_config(tmp_path / "held.yaml"), Catalog.read(survey))
    run_tiles(run, executor)
    table = read_metrics(run.path)
    assert table.holdout_squares.sum() > 5
    assert table.holdout_error_m.dropna().between(0.001, 0.3).all()
    assert gather(run).tables[HELD_OUT][0]["withheld squares"][0] == table.holdout_squares.sum()


def test_tables_without_error_estimates_are_empty():
    old = rows([np.nan])
    assert over_tiles(old, ["flexroad"]).empty
    assert highest_error_estimates(old, "flexroad", 10).empty


def test_gather_ranks_tiles_by_error_estimate(survey, quick_config, tmp_path):
    run = Run.create(tmp_path / "run", load_config(quick_config), Catalog.read(survey))
    run_tiles(run, SerialExecutor())
    table = read_metrics(run.path)
    assert list(table.columns) == list(COLUMNS)
    shares = table[["measured_road", "dtm_road", "inferred_road"]].sum(axis=1)
    np.testing.assert_allclose(shares, 1)
    worst, _ = gather(run).tables[WORST_ESTIMATES]
    flexroad = table[table.variant == "flexroad"].set_index("tile_id")
    assert list(worst.tile) == list(flexroad.error_estimate_m.sort_values(ascending=False).index)
    # The exported map has the classes that the shares are counted on.
    tile = worst.tile[worst.index[0]]
    folder = run.folder(tile).path
    with rasterio.open(folder / f"{tile}_flexroad_height_source.tif") as raster:
        assert raster.nodata == HeightSource.NONE
        assert set(np.unique(raster.read(1))) <= set(HeightSource)
