"""The page's words, data and comparison, without a browser."""

import json
import re
from dataclasses import replace

import numpy as np
import pandas as pd
import pyproj
import pytest

from flexroad.catalog import Catalog
from flexroad.pipeline.config.loading import load_config
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.execute import SerialExecutor
from flexroad.pipeline.run.lock import run_lock
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.run.runner import run_tiles
from flexroad.pipeline.store.tables import COLUMNS, LABELS, METRICS, metrics_frame
from flexroad.tasks.quality.assess import FLAGS, NO_ROAD, STRUCTURE_FLAGS
from flexroad.tools.report import _viewer_address, write_report
from flexroad.tools.report.browser.figures import compare, histograms
from flexroad.tools.report.browser.outcome import MEANINGS, headline, reasons, statements
from flexroad.tools.report.browser.page import html_page, ranking
from flexroad.tools.report.browser.tiles import NAMES, as_script, errors, map_data, tile_table
from tests.made_report import failed_row, made_content, made_row, made_run

EVIL = "<script>alert(1)</script>"
IDS = ["a", "b", "c", "d"]
ERROR = "load: TaskError: dsm x.tif is missing; restore it"
ROWS = [
    made_row("a", 0.02),
    made_row("b", 0.3, "error-estimate, spike"),
    made_row("c", 0.01, "no-road"),
    failed_row("d", ERROR),
]


@pytest.fixture
def run(tmp_path, made_survey):
    return made_run(tmp_path / "my run", made_survey / "catalog.parquet", IDS)


def said(run, rows, **counts):
    content = made_content(run, rows)
    content = replace(content, counts=replace(content.counts, **counts))
    table = tile_table(run.catalog.tiles, content)
    lines = statements(content, table, errors(content), str(run.path))
    return headline(table, content.counts.skipped), [(line.kind, line.text, line.command) for line in lines]


@pytest.mark.parametrize("flag", MEANINGS)
def test_remedy_is_a_whole_sentence_with_and_without_a_place(flag):
    ((_, text),) = reasons({"flags": flag}, {})
    ((_, placed),) = reasons({"flags": flag}, {flag: (1.0, 2.0)})
    assert MEANINGS[flag].words
    assert MEANINGS[flag].remedy
    assert "{" not in text + placed
    assert not re.search(r"\b(if|whether) is\b|  | :", text.partition("; ")[2])


def test_files_that_the_catalog_skipped_are_told_first(tmp_path, made_survey):
    run = made_run(tmp_path / "run", made_survey / "catalog.parquet", ["a"])
    rows = [made_row("a", 0.02)]
    assert said(run, rows)[0] == "Yes: the tile is done, none is flagged."
    lines = ("skipped x.tif (dsm): it is damaged",)
    answer, told = said(run, rows, skipped=1, left_out=lines)
    assert answer == "In part: the tile is done, but the catalog skipped 1 file."
    text = (
        "The catalog lacks 1 file that cannot be used: skipped x.tif (dsm): it is damaged. Repair what was "
        "skipped, repeat the `flexroad catalog` command, then `flexroad run`."
    )
    assert told[0] == ("failed", text, "")


def test_all_columns_of_the_metrics_and_all_flags_have_words():
    numbers = {name for name, kind in COLUMNS.items() if kind != "str"}
    assert set(LABELS) == numbers - {"worst_easting", "worst_northing"}
    assert set(NAMES) < set(COLUMNS)
    assert set(MEANINGS) == {*FLAGS, NO_ROAD, *STRUCTURE_FLAGS}


def test_dropped_road_under_a_dsm_off_the_dtm_has_that_as_its_reason():
    row = {"flags": "dropped, inferred", "dropped_road": 1.0, "inferred_road": 0.6}
    notes = ("dsm resampled", "the DSM lies 47.0 m above the DTM: ellipsoidal heights?")
    dropped, inferred = reasons(row, {}, notes)
    assert dropped[1].endswith("; the DSM lies 47.0 m above the DTM (ellipsoidal heights?)")
    assert inferred == reasons(row, {})[1]


def test_reason_names_value_limit_place_and_remedy():
    (reason,) = reasons({"flags": "spike", "curvature_per_m": 0.31}, {"spike": (588612.4, 4519130.0)})
    assert reason == (
        "spike",
        "the surface bends more than a road can (0.31 1/m, limit 0.2 1/m), at 588,612 / 4,519,130; "
        "look at the mask there: it may reach over a wall, a roof or a bank",
    )
    ((flag, text),) = reasons({"flags": "dropped", "dropped_road": 0.75}, {})
    assert flag == "dropped"
    assert text.startswith("the filter dropped 75% of the road mask (limit 50%); look whether")
    assert reasons({"flags": np.nan}, {}) == []
    assert reasons({"flags": "of-later-versions"}, {})[0][0] == "of-later-versions"


def test_outcome_names_states_causes_and_commands(run):
    answer, lines = said(run, ROWS)
    assert answer == "In part: 3 of 4 tiles are done; 1 failed."
    kinds = {kind: (text, command) for kind, text, command in lines}
    assert kinds["failed"][0].startswith(f"1 tile failed. {ERROR}.")
    assert kinds["failed"][1] == f"flexroad rerun '{run.path}' --failed"
    assert "error-estimate 1, spike 1" in kinds["flagged"][0]
    assert kinds["no-road"][0].startswith("1 tile has no road")


@pytest.mark.parametrize(
    ("rows", "answer"),
    [
        ([made_row(name, 0.01) for name in IDS], "Yes: all 4 tiles are done, none is flagged."),
        ([failed_row(name, ERROR) for name in IDS], "No: no tile is done; 4 failed."),
        ([], "No: no tile is done; 4 are pending."),
        (
            [made_row("a", 0.3, "spike"), *[made_row(name, 0.1) for name in "bcd"]],
            "Yes: all 4 tiles are done, 1 is flagged.",
        ),
    ],
)
def test_headline_of_other_runs(run, rows, answer):
    assert said(run, rows)[0] == answer


def test_failures_of_one_kind_are_one_line_with_their_number(run):
    rows = [
        failed_row(name, f"load: TaskError: dsm dsm/{i}.tif is missing; restore it")
        for i, name in enumerate(IDS)
    ]
    _, ((_, text, _), *_) = said(run, rows)
    assert "(4 tiles of this kind)" in text
    assert text.count("is missing") == 1


def test_figures_of_tiles_that_are_not_done_are_left_out(run):
    content = made_content(run, ROWS, states={"b": "pending"})
    table = tile_table(run.catalog.tiles, content)
    assert table.states == ("fine", "pending", "no-road", "failed")
    assert np.isnan(table.frame.error_estimate_m["b"])
    data = json.loads(as_script(map_data(table, errors(content), {})))
    assert data["states"] == [0, 4, 2, 3]
    assert data["errors"] == {"3": ERROR}
    assert data["boxes"][1] == [250, 0, 500, 250]
    values = {column["key"]: column.get("values") for column in data["columns"]}
    assert values["error_estimate_m"] == [0.02, None, 0.01, None]
    assert "nearest_road_m" not in values


def test_tiles_in_another_crs_are_placed_by_one_transformer(run, monkeypatch):
    content = made_content(run, ROWS)
    first, *others = run.catalog.tiles
    far = [replace(tile, grid=replace(tile.grid, crs="EPSG:25833")) for tile in others[1:]]
    to_crs = pyproj.Transformer.from_crs("EPSG:25833", first.grid.crs, always_xy=True)
    expected = [to_crs.transform_bounds(*tile.grid.bounds) for tile in far]
    made = []
    monkeypatch.setattr(pyproj.Transformer, "from_crs", lambda *crs, **how: made.append((crs, how)) or to_crs)
    table = tile_table([first, others[0], *far], content)
    np.testing.assert_array_equal(table.bounds[2:], expected)
    np.testing.assert_array_equal(table.bounds[0], first.grid.bounds)
    assert made == [(("EPSG:25833", first.grid.crs), {"always_xy": True})]


def test_ranking_takes_the_road_error_without_estimates_and_nothing_without_figures(run):
    def first(rows):
        return ranking(tile_table(run.catalog.tiles, made_content(run, rows)))[1]

    assert first(ROWS) == ["b", "a", "c"]
    old = [row | {"error_estimate_m": np.nan} for row in ROWS]
    assert first(old) == ["b", "a", "c"]
    assert first([failed_row("a", ERROR)]) == []


def test_script_data_cannot_begin_a_tag():
    text = as_script({"id": f"{EVIL}&amp;\u2028"})
    assert not set("<>&\u2028") & set(text)
    assert json.loads(text) == {"id": f"{EVIL}&amp;\u2028"}


def test_comparison_counts_better_and_worse_tiles(run):
    table = tile_table(run.catalog.tiles, made_content(run, ROWS))
    before = metrics_frame([made_row("a", 0.02), made_row("b", 0.1), made_row("d", 0.1)])
    comparison = compare(table, before, "flexroad", "last week")
    assert comparison.line == (
        "Compared with last week: 2 tiles done in both runs, 1 done only now, 1 done only before."
    )
    row = comparison.table.iloc[0]
    assert (row.before, row.now, row.change) == ("0.06", "0.16", "+0.1")
    assert (row.better, row.same, row.worse) == (0, 1, 1)
    assert list(comparison.worse.tile) == ["b"]
    figures = comparison.table.set_index("figure, mean over tiles")
    assert figures.now["triangles"] == "20,000"
    assert list(figures.loc["computing time (s)", ["better", "same", "worse"]]) == ["–"] * 3
    np.testing.assert_allclose(comparison.columns["change_m"][2], [0, 0.2, np.nan, np.nan], atol=1e-12)
    other = compare(table, before.assign(variant="other"), "flexroad", "x")
    assert other.table.empty
    assert other.columns == {}
    assert other.line == "Nothing can be compared with x: no tile is done in both."


def test_histogram_has_all_tiles_and_the_threshold():
    values = pd.Series([*np.linspace(0.01, 0.09, 50), 0.2, np.nan, 5.0])
    ((_, svg, line),) = histograms(
        {"error_estimate_m": ("error estimate", "m", values)}, {"error_estimate_m": 0.1}
    )
    counted = [int(part.split(" tile")[0]) for part in svg.split(": ")[1:]]
    assert sum(counted) == 52
    assert "flag above 0.1" in svg
    assert line.endswith("52 tiles")
    assert list(histograms({"seconds": ("time", "s", pd.Series([1.0, 2.0]))}, {})) == []


@pytest.mark.parametrize("rows", [ROWS, [failed_row(name, EVIL) for name in IDS], [], ROWS[:1]])
def test_page_of_runs_without_meshes_and_with_markup_is_whole(tmp_path, made_survey, rows):
    names = {"a": "a", "b": EVIL, "c": "c & d", "d": '"><img src=x onerror=alert(1)>'}
    run = made_run(tmp_path / "RUN", made_survey / "catalog.parquet", list(names.values()))
    rows = [row | {"tile_id": names[row["tile_id"]]} for row in rows]
    page = html_page(run, made_content(run, rows), "view/index.html")
    done = [row["tile_id"] for row in rows if row["status"] == "done"]
    assert ('href="view/index.html#tile=a"' in page) == ("a" in done)
    assert EVIL not in page
    assert "<img src=x" not in page
    assert page.count("<script") == 2
    for heading in ("Did it work?", "Where?", "How good?", "What to look at first", "Details"):
        assert f"<h2>{heading}</h2>" in page


@pytest.mark.slow
def test_report_before_the_end_of_the_first_run_has_the_tiles_so_far(made_survey, tmp_path):
    run = Run.create(
        tmp_path / "RUN", load_config("production"), Catalog.read(made_survey / "catalog.parquet")
    )
    first = run.catalog.tiles[0]
    run_tiles(run, SerialExecutor(), only=lambda tile: tile == first)
    (run.path / METRICS).unlink()
    page = write_report(run, "html").read_text()
    assert "In part: 1 of 4 tiles are done; 3 are pending." in page
    assert f"flexroad rerun {run.path}" in page
    with run_lock(run.path):
        page = write_report(run, "html").read_text()
    assert "3 tiles have no result yet; the run is in progress." in page
    assert f"flexroad rerun {run.path}" not in page


def test_report_with_wrong_folders_names_the_remedy(run, tmp_path):
    with pytest.raises(ConfigError, match=r"has no index.html; make it with `flexroad view"):
        write_report(run, "html", viewer=tmp_path)
    with pytest.raises(ConfigError, match="is no run"):
        write_report(run, "html", compared=tmp_path)
    assert not (run.path / "report.html").exists()


def test_viewer_is_found_in_the_run_or_given_and_its_address_is_relative(run, tmp_path):
    assert _viewer_address(run, None) == ""
    for folder in (run.path / "viewer", tmp_path / "3D & more"):
        folder.mkdir()
        (folder / "index.html").touch()
    assert _viewer_address(run, None) == "viewer/index.html"
    assert _viewer_address(run, tmp_path / "3D & more") == "../3D%20%26%20more/index.html"
