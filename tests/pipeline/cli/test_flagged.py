"""A road over a heap: run, status, summary.json and report say which tile, and all others what passes it."""

import csv
import io
import json
import os
from pathlib import Path

import geopandas
import numpy as np
import pandas as pd
import pytest
from shapely import LineString

from flexroad.pipeline.run.finished import flagged
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.run.status import summary
from flexroad.pipeline.store.tables import read_metrics
from tests import command_line
from tests.make_rasters import UTM, write

WEST, SOUTH, SIZE = 500_000.0, 5_600_000.0, 80
HEAP, HEIGHT_M = (WEST + 120.0, SOUTH + 40.0), 5.0
"""The heap stands on the second of two tiles."""
FLAGGED, SOUND = "500080_5600000", "500000_5600000"
OVER = LineString([(WEST + 90, SOUTH + 40), (WEST + 150, SOUTH + 40)])
BESIDE = LineString([(WEST + 90, SOUTH + 66), (WEST + 150, SOUTH + 66)])
RAISED = "worst-error"


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
    """Return a run on a car park of two tiles with a heap, which no filter takes away."""
    folder = tmp_path_factory.mktemp("heap")
    row, col = np.indices((SIZE, 2 * SIZE))
    away = np.hypot(WEST + col + 0.5 - HEAP[0], SOUTH + SIZE - row - 0.5 - HEAP[1])
    ground = 100.0 + 0.01 * col
    heap = np.clip(HEIGHT_M - 0.5 * np.clip(away - 3, 0, None), 0, None)
    noise = 0.02 * np.random.default_rng(1).standard_normal(ground.shape)
    road = np.ones(ground.shape, np.uint8)
    for name, values in (("dsm", ground + heap + noise), ("dtm", ground), ("road_mask", road)):
        write(folder / f"{name}.tif", values, WEST, SOUTH + SIZE)
    layers = ["--dsm", "dsm.tif", "--dtm", "dtm.tif", "--road-mask", "road_mask.tif", "--road-value", 1]
    catalog = folder / "catalog.json"
    command_line.call("catalog", "rasters", folder, *layers, "--tile-size", SIZE, "-o", catalog).expected(0)
    words = ["--config", "production", "--set", 'ecsrc.method="off"', "--catalog", catalog]
    said = command_line.call("run", *words, "--out", folder / "run", "--executor", "serial").expected(0)
    (folder / "said.txt").write_text(said.out)
    return folder / "run"


def lines(folder: Path) -> Path:
    table = geopandas.GeoDataFrame(
        {"name": ["over", "beside"], "width_m": [6.0, 6.0]}, geometry=[OVER, BESIDE], crs=UTM
    )
    table.to_file(folder / "roads.gpkg")
    return folder / "roads.gpkg"


def profile(flexroad, run, line, step) -> tuple[pd.DataFrame, str]:
    text = ", ".join(f"{x} {y}" for x, y in line.coords)
    said = flexroad("query", run, "--line", text, "--step", step).expected(0)
    return pd.read_csv(io.StringIO(said.out), keep_default_na=False), said.err


def test_metrics_have_height_and_place_of_heap(run):
    rows = read_metrics(Run.open(run).path).set_index("tile_id")
    heap, sound = rows.loc[FLAGGED], rows.loc[SOUND]
    assert heap.worst_error_estimate_m == pytest.approx(HEIGHT_M, abs=0.5)
    place = heap.worst_easting, heap.worst_northing
    assert np.hypot(place[0] - HEAP[0], place[1] - HEAP[1]) < 8
    assert heap.error_estimate_m < HEIGHT_M / 10
    assert RAISED in heap["flags"].split(", ")
    assert sound.worst_error_estimate_m < 0.1
    assert sound["flags"] == ""


def test_run_status_summary_and_report_say_what_to_look_at(run, flexroad):
    said = (run.parent / "said.txt").read_text().splitlines()
    shown = flexroad("status", run).expected(0).out
    for line in (said[0], shown.splitlines()[0]):
        assert line.startswith("2 tiles: 2 done (0 cached), 0 failed, 0 pending; 2 new")
        assert "s; 1 to look at" in line
    assert f"to look at: {FLAGGED}\n" in shown
    assert json.loads((run / "summary.json").read_text())["flagged"] == [FLAGGED]
    assert json.loads(flexroad("status", run, "--json").expected(0).out)["flagged"] == [FLAGGED]
    report = flexroad("report", run).expected(0).out
    assert "Tiles: 2 done, 0 failed, 0 pending; 1 to look at" in report
    page = flexroad("report", run, "--format", "html").expected(0) and (run / "report.html").read_text()
    assert "1 done tile should be looked at" in page
    assert "25 m² of road in one piece are" in page


def test_flagged_tiles_are_found_without_database_and_after_another_run(run, flexroad, tmp_path):
    opened = Run.open(run)
    known = (run / "database.txt").read_bytes()
    assert summary(opened).flagged == (FLAGGED,)
    (run / "database.txt").write_bytes(b"")
    try:
        assert summary(opened).flagged == (FLAGGED,)
    finally:
        (run / "database.txt").write_bytes(known)
    again = flexroad("rerun", run, "--executor", "serial").expected(0).out
    assert "2 done (2 cached)" in again
    assert "; 1 to look at; results in" in again


@pytest.mark.parametrize("step", [1, 5, 40])
def test_profile_over_heap_has_flag_and_beside_it_has_none(run, flexroad, step):
    over, said = profile(flexroad, run, OVER, step)
    flagged = over[over["flags"].str.contains(RAISED)]
    assert len(flagged) >= 1
    assert "flagged places" in said
    # Steps of 40 m jump over the heap; the flags are those up to the next point.
    first = HEAP[0] - WEST - 90 - 13 - step
    assert flagged.distance_m.between(first, HEAP[0] - WEST - 90 + 13).all()
    beside, said = profile(flexroad, run, BESIDE, step)
    assert set(beside["flags"]) == {""}
    assert "flagged" not in said


def test_points_on_heap_and_beside_it(run, flexroad, tmp_path):
    points = tmp_path / "points.csv"
    points.write_text(f"easting,northing\n{HEAP[0] + 5},{HEAP[1]}\n{HEAP[0]},{HEAP[1] + 26}\n")
    said = flexroad("query", run, "--points", points).expected(0)
    table = pd.read_csv(io.StringIO(said.out), keep_default_na=False)
    assert [RAISED in names.split(", ") for names in table["flags"]] == [True, False]
    assert "1 point lies on flagged places" in said.err


def test_lift_names_features_over_heap(run, flexroad, tmp_path):
    report = tmp_path / "report.csv"
    out = tmp_path / "lifted.gpkg"
    said = flexroad("lift", lines(tmp_path), run, "-o", out, "--report", report).expected(0)
    assert "1 feature passes flagged places (1: " in said.err
    rows = list(csv.DictReader(report.open()))
    assert [RAISED in row["flags"] for row in rows] == [True, False]


def test_export_and_lift_of_opendrive_name_roads_over_heap(run, flexroad, tmp_path):
    out, report, forms = tmp_path / "out", tmp_path / "report.csv", ("crg", "xodr", "lines")
    words = ["--roads", lines(tmp_path), "--format", ",".join(forms), "-o", out, "--workers", 1]
    said = flexroad("export", run, *words).expected(0)
    entries = json.loads((out / "export.json").read_text())["formats"]
    for form in forms:
        assert f"note: {form}: 1 road passes flagged places (1000: " in said.err
        assert list(entries[form]["flagged_roads"]) == ["1000"]
    (source,), (package,) = (out / "xodr").glob("*.xodr"), (out / "lines").glob("*.gpkg")
    flexroad("lift", source, run, "-o", tmp_path / "x.xodr", "--report", report).expected(0)
    tables = [out / "crg" / "roads.csv", out / "xodr" / "roads.csv", report]
    columns = [pd.read_csv(table, keep_default_na=False)["flags"] for table in tables]
    for names in (*columns, geopandas.read_file(package, layer="roads")["flags"]):
        assert [RAISED in name for name in names] == [True, False]


def test_flags_of_tile_with_changed_sources_are_the_last_ones_or_unknown(run, flexroad):
    dsm, results, aside = run.parent / "dsm.tif", run / "store" / "assess", run.parent / "aside"
    before = dsm.stat()
    os.utime(dsm, ns=(before.st_atime_ns, before.st_mtime_ns + 10**9))
    try:
        last, _ = profile(flexroad, run, OVER, 1)
        results.rename(aside)
        # Each command is a process of its own, which has read no flags yet.
        flagged.cache_clear()
        unknown, said = profile(flexroad, run, OVER, 1)
    finally:
        if aside.exists():
            aside.rename(results)
        os.utime(dsm, ns=(before.st_atime_ns, before.st_mtime_ns))
    assert last["flags"].str.contains(RAISED).any()
    assert set(unknown["flags"]) == {"unknown"}
    assert "sources or options of 1 tile have changed" in said
