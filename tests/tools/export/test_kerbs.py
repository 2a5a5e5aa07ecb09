"""Formats of the smooth surface say by how much it differs from the surface with kerbs and walls."""

import csv
import json

import geopandas
import numpy as np
import pytest
import rasterio
import shapely

import flexroad
from flexroad.catalog import Catalog
from flexroad.pipeline.config.loading import load_config
from flexroad.pipeline.execute import SerialExecutor
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.run.runner import run_tiles
from flexroad.tasks.spline.stepped import without_steps
from flexroad.tools.export.driver import export
from flexroad.tools.export.source import Options, select
from flexroad.tools.synthetic.scenes import write_scenes
from tests import make_roads
from tests.tools.export.test_step import read_surface

SIZE_M, HALF_M, LOWER_M = 60, 5, 0.4
"""Side of the tile; half the width of a road through its middle; depth of the ground beside it."""
FORMATS = ["crg", "xodr", "lines", "step"]


def ground(easting, west):
    """The road: a slope of 2% to the east."""
    return 125 + 0.02 * (easting - west)


@pytest.fixture(scope="module", params=[LOWER_M, 0.0], ids=["kerb", "level"])
def street(request, tmp_path_factory):
    """A run of one tile, and the height of its kerb (m)."""
    folder = tmp_path_factory.mktemp("street")
    catalog = Catalog.read(write_scenes(folder / "survey", 1, seed=3, size_m=SIZE_M))
    (tile,) = catalog.tiles
    road = np.abs(tile.grid.northings - tile.grid.south - SIZE_M / 2) < HALF_M
    heights = ground(tile.grid.eastings, tile.grid.west) - np.where(road, 0.0, request.param)[:, None]
    mask = np.broadcast_to(road[:, None], heights.shape)
    for layer, values in (("dsm", heights), ("dtm", heights), ("road_mask", mask)):
        with rasterio.open(folder / "survey" / layer / f"{tile.id}.tif", "r+") as raster:
            raster.write(values.astype(raster.dtypes[0]), 1)
    run = Run.create(folder / "run", load_config("production"), catalog)
    assert run_tiles(run, SerialExecutor()).done == 1
    return run.path, request.param


def exported(run, width_m, out):
    """Export with a centre line of a width; return the entries of the manifest and the row of its road."""
    (tile,) = Catalog.read(run / "catalog.parquet").tiles
    west, south, east, _ = tile.grid.bounds
    y = south + SIZE_M / 2
    line = shapely.LineString([(west + 5.0, y), (east - 5.0, y)])
    roads = make_roads.write(out / "roads.gpkg", [line], "EPSG:25832", width_m=[width_m])
    options = Options(roads=str(roads))
    entries = export(select(run), out / "out", FORMATS, options, SerialExecutor())["formats"]
    with (out / "out" / "crg" / "roads.csv").open() as file:
        (row,) = csv.DictReader(file)
    return entries, row


def steps(run, half_m=SIZE_M):
    """Return by how much the surface of queries and the smooth one differ at most."""
    (tile,) = select(run).finished()
    west, south, _, _ = tile.tile.grid.bounds
    x, y = np.meshgrid(np.arange(5.5, 55), np.arange(0.125, SIZE_M, 0.25))
    x, y = (values[np.abs(y - SIZE_M / 2) <= half_m] for values in (west + x, south + y))
    return np.abs(flexroad.open_run(run).height(x, y) - without_steps(tile.surface).height(x, y)).max()


def test_wide_road_has_its_largest_step_in_report_manifest_and_summary(street, tmp_path):
    run, kerb = street
    entries, row = exported(run, 14.0, tmp_path)
    widths = {"crg_steps_max_mm": 8, "carriageway_steps_max_mm": 7}
    for name, half_m in widths.items():
        assert float(row[name]) == pytest.approx(1000 * steps(run, half_m), abs=2)
        assert entries["crg"][name] == entries["xodr"][name] == float(row[name])
    largest = float(row["carriageway_steps_max_mm"]) / 1000
    assert 0.75 * kerb <= largest <= kerb + 0.001
    lines = geopandas.read_file(next((tmp_path / "out" / "lines").iterdir()), layer="roads")
    assert lines.steps_max_m[0] == pytest.approx(largest, abs=0.005)
    assert entries["lines"]["steps_max_m"] == pytest.approx(lines.steps_max_m[0], abs=1e-6)
    differs = f"kerbs and walls it differs by up to {largest:.2f} m, where the run has no road"
    assert entries["xodr"]["summary"].endswith(differs if kerb else "mm")
    assert ("along the surface without kerbs and walls; with" in entries["lines"]["summary"]) == bool(kerb)
    missed = "misses the surface without kerbs and walls by" if kerb else "misses the surface by"
    assert missed in entries["crg"]["summary"]
    assert missed in entries["xodr"]["summary"]
    # The error is that against the smooth surface, a plane.
    assert float(row["crg_max_mm"]) < 1


def test_road_within_the_mask_has_no_step_and_step_says_what_it_leaves_out(street, tmp_path):
    run, kerb = street
    entries, row = exported(run, 6.0, tmp_path)
    assert float(row["crg_steps_max_mm"]) == float(row["carriageway_steps_max_mm"]) == 0
    for name in ("crg", "xodr", "lines"):
        assert "kerbs" not in entries[name]["summary"]
    assert "misses the surface by at most" in entries["crg"]["summary"]
    (tile,) = Catalog.read(run / "catalog.parquet").tiles
    (west, south, _, _), out = tile.grid.bounds, tmp_path / "out"
    about = json.loads((out / "step" / f"{tile.id}_stp.json").read_text())
    differs = f"with kerbs and walls it differs by up to {steps(run):.2f} m, where the run has no road"
    assert entries["step"]["steps_max_m"] == pytest.approx(steps(run), abs=0.001)
    assert entries["step"].get("summary", "").endswith(differs if kerb else "")
    assert ("summary" in entries["step"]) == bool(kerb)
    assert about["steps_max_m"] == entries["step"]["steps_max_m"]
    surface = read_surface((out / "step" / f"{tile.id}.stp").read_text())
    for y in (24.5, 25.5, 34.5, 35.5):
        smooth, on_road = surface.evaluate_single((30.5 / SIZE_M, y / SIZE_M))[2], abs(y - 30) < HALF_M
        whole = float(flexroad.open_run(run).height(west + 30.5, south + y))
        assert whole == pytest.approx(ground(30.5, 0) - (0 if on_road else kerb), abs=0.03)
        assert smooth - whole == pytest.approx(0 if on_road else kerb, abs=0.25 * kerb + 0.001)
