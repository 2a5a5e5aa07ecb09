"""Which tiles a report sends its reader to, where nobody knows the truth."""

import numpy as np
import pandas as pd
import pytest
import rasterio

from flexroad.catalog import Catalog
from flexroad.pipeline.config.loading import load_config
from flexroad.pipeline.execute import SerialExecutor
from flexroad.pipeline.report.content import gather
from flexroad.pipeline.report.quality import most_doubtful, over_tiles
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.run.runner import run_tiles
from flexroad.pipeline.store.tables import COLUMNS, metrics_frame, read_metrics
from flexroad.tasks.quality.support import Support


def rows(doubts, flags=()) -> pd.DataFrame:
    made = [
        {
            "tile_id": f"t{i}",
            "variant": "flexroad",
            "status": "done",
            "error_estimate_m": doubt,
            "off_dtm_road": 0.25,
        }
        for i, doubt in enumerate(doubts)
    ]
    for row, flag in zip(made, flags, strict=False):
        row["flags"] = flag
    return metrics_frame(made)


def test_the_most_doubtful_come_first():
    found = most_doubtful(rows([0.1, np.nan, 0.3, 0.2], ["", "no-road", "doubt, patch", ""]), "flexroad", 2)
    assert list(found.tile) == ["t2", "t3"]
    assert list(found["flags"]) == ["doubt, patch", "–"]
    assert list(found["off the DTM (%)"]) == [25, 25]


def test_means_count_the_tiles_with_flags():
    found = over_tiles(rows([0.1, 0.2, 0.6], ["", "spike", "error-estimate"]), ["flexroad"]).iloc[0]
    assert found["doubt (m)"] == pytest.approx(0.3)
    assert found["flagged tiles"] == 2


def test_rows_of_earlier_days_say_nothing():
    old = rows([np.nan])
    assert over_tiles(old, ["flexroad"]).empty
    assert most_doubtful(old, "flexroad", 10).empty


def test_a_run_tells_of_itself(survey, quick_config, tmp_path):
    run = Run.create(tmp_path / "run", load_config(quick_config), Catalog.read(survey))
    run_tiles(run, SerialExecutor())
    table = read_metrics(run.path)
    assert list(table.columns) == list(COLUMNS)
    shares = table[["measured_road", "dtm_road", "inferred_road"]].sum(axis=1)
    np.testing.assert_allclose(shares, 1)
    worst = gather(run).doubtful
    flexroad = table[table.variant == "flexroad"].set_index("tile_id")
    assert list(worst.tile) == list(flexroad.error_estimate_m.sort_values(ascending=False).index)
    # The map that is exported is the one the shares were counted on.
    tile = worst.tile[worst.index[0]]
    folder = run.folder(tile).path
    with rasterio.open(folder / f"{tile}_flexroad_support.tif") as raster:
        assert raster.nodata == Support.NONE
        assert set(np.unique(raster.read(1))) <= set(Support)
    # Runs of earlier days have fewer columns, and are read all the same.
    table.drop(columns=["error_estimate_m", "flags"]).to_parquet(run.path / "metrics.parquet")
    assert gather(run).doubtful.empty
