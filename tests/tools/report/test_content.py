"""The tables of the report, and pages that show texts from files as they are."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
import rasterio
import yaml
from markdown_it import MarkdownIt

from flexroad.catalog import Catalog
from flexroad.pipeline.config.loading import compose, load_config
from flexroad.pipeline.execute import SerialExecutor
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.run.runner import run_tiles
from flexroad.pipeline.store.tables import COLUMNS, metrics_frame, read_metrics
from flexroad.tasks.quality.height_source import HeightSource
from flexroad.tools.report.content import (
    HELD_OUT,
    MESH_COLUMNS,
    WORST_ESTIMATES,
    decks_and_tunnels,
    gather,
    held_out,
    highest_error_estimates,
    mesh_checks,
    over_tiles,
)
from flexroad.tools.report.pages import markdown, markdown_page, template
from tests.builders import LIGHT


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


def test_run_with_holdout_fits_twice_and_reports_its_squares(survey, tmp_path):
    options = {"extends": "production", "assess": {"holdout": 0.5}}
    (tmp_path / "held.yaml").write_text(yaml.safe_dump(options))
    run = Run.create(tmp_path / "run", load_config(tmp_path / "held.yaml"), Catalog.read(survey))
    run_tiles(run, SerialExecutor())
    table = read_metrics(run.path)
    assert table.holdout_squares.sum() > 5
    assert table.holdout_error_m.dropna().between(0.001, 0.3).all()
    assert gather(run).tables[HELD_OUT][0]["withheld squares"][0] == table.holdout_squares.sum()


def test_tables_without_error_estimates_are_empty():
    old = rows([np.nan])
    assert over_tiles(old, ["flexroad"]).empty
    assert highest_error_estimates(old, "flexroad", 10).empty


def test_gather_ranks_tiles_by_error_estimate(light_run):
    table = read_metrics(light_run.path)
    assert list(table.columns) == list(COLUMNS)
    shares = table[["measured_road", "dtm_road", "inferred_road"]].sum(axis=1)
    np.testing.assert_allclose(shares, 1)
    worst, _ = gather(light_run).tables[WORST_ESTIMATES]
    flexroad = table[table.variant == "flexroad"].set_index("tile_id")
    assert list(worst.tile) == list(flexroad.error_estimate_m.sort_values(ascending=False).index)
    # The exported map has the classes that the shares are counted on.
    tile = worst.tile[worst.index[0]]
    folder = light_run.folder(tile).path
    with rasterio.open(folder / f"{tile}_flexroad_height_source.tif") as raster:
        assert raster.nodata == HeightSource.NONE
        assert set(np.unique(raster.read(1))) <= set(HeightSource)


FAULT = "evaluate: MeshFault: the mesh has 2 inverted faces (the first at 1.000, 2.000)"


def made(variant, triangles=None, error=""):
    status = "failed" if error else "done"
    return {"tile_id": "t", "variant": variant, "status": status, "triangles": triangles, "error": error}


@pytest.mark.parametrize(
    ("rows", "expected"),
    [
        (
            [made("a", 10), made("a", 20), made("b", 5)],
            [("a", 2, 30, 0, "no fault"), ("b", 1, 5, 0, "no fault")],
        ),
        ([made("a", 10), made("a", error=FAULT)], [("a", 2, 10, 1, "error: 1 of 2 meshes have faults")]),
        ([made("a", error=FAULT)], [("a", 1, 0, 1, "error: 1 of 1 meshes have faults")]),
        ([made("a", error="load: TaskError: no MeshFault: x")], []),
    ],
)
def test_mesh_checks_count_meshes_faces_and_faults(rows, expected):
    pd.testing.assert_frame_equal(
        mesh_checks(metrics_frame(rows), ["a", "b", "c"]),
        pd.DataFrame(expected, columns=MESH_COLUMNS),
        check_dtype=False,
    )


def test_table_of_decks_has_flagged_ones_first():
    figures = {
        "area_m2": 160.0,
        "abutments": 2,
        "clearance_m": 6.5,
        "error_estimate_m": None,
        "measured_road": 0.9,
    }
    rows = [
        {"tile_id": name, "variant": variant, "level": level, **figures, "flags": flags}
        for name, variant, level, flags in [("t", "a", 1, ""), ("t", "b", 1, ""), ("u", "a", -1, "no-rise")]
    ]
    table = decks_and_tunnels(rows, "a")
    assert table.columns[:5].tolist() == ["tile", "level", "area (m²)", "abutments", "clearance (m)"]
    assert table.columns[5:].tolist() == ["error estimate (m)", "measured (%)", "flags"]
    assert table[["tile", "level", "flags"]].to_numpy().tolist() == [["u", -1, "no-rise"], ["t", 1, "–"]]
    assert table["measured (%)"].tolist() == [90, 90]
    assert decks_and_tunnels(rows, "c").empty


EVIL = "\x1b[2J<img src=x>`a` *b* _c_ [d](e) f|g ~h~ &amp; \nx"


def test_markdown_escapes_markup_and_controls():
    table = markdown(pd.DataFrame([(EVIL, "295500_5629250", 1.5)], columns=["message", "tile", "m"]))
    *_, row = table.splitlines()
    assert row == (
        r"| \\x1b[2J&lt;img src=x>\`a\` \*b\* \_c\_ [d\](e) f\|g \~h\~ &amp;amp; \\nx "
        "| 295500_5629250 | 1.500 |"
    )


def test_markdown_keeps_intervals():
    assert "| 0.1 [0.0, 0.2] |" in markdown(pd.DataFrame([("0.1 [0.0, 0.2]",)], columns=["a"]))


def test_html_escapes_markup_and_controls(tmp_path):
    (tmp_path / "x.j2").write_text("<p>{{ text }}</p>{{ table | table }}")
    page = template("x.j2", tmp_path).render(text=EVIL, table=pd.DataFrame({"a": [EVIL]}))
    assert "<img" not in page
    assert all(line.isprintable() for line in page.split("\n"))
    assert page.startswith(r"<p>\x1b[2J&lt;img src=x&gt;`a`")
    assert "<table>" in page


def test_report_of_a_run_with_markup_in_its_texts_has_no_html(survey, tmp_path):
    """Ids, options, versions and data sets come from files."""
    evil = "<script>alert(1)</script>"
    given = Catalog.read(survey).tiles
    tiles = tuple(replace(tile, id=f"{evil}{n}", dataset=evil) for n, tile in enumerate(given))
    tiles[0].paths(tiles[0].layers[0])[0].unlink()
    config = compose(LIGHT | {"dataset": {"name": evil}}, evil)
    run = Run.create(tmp_path / "run", config, Catalog(tiles))
    run_tiles(run, SerialExecutor())
    page = markdown_page(gather(replace(run, versions={"flexroad": evil})))
    assert page.count("&lt;script>") > 10
    before, _, rest = page.partition("```yaml")
    assert "<script" not in before + rest.rpartition("```")[2]
    assert "<script" not in MarkdownIt("commonmark").enable("table").render(page)
