"""``flexroad export`` and its selection of tiles by an area."""

import json

import geopandas
import pytest
import shapely

from tests.command_line import call


@pytest.fixture
def area(town, tmp_path):
    """Returns a function that writes an area in longitude and latitude over bounds."""

    def write(*bounds):
        path = tmp_path / "area.geojson"
        shape = geopandas.GeoSeries([shapely.box(*bounds)], crs="EPSG:25832")
        shape.to_crs("EPSG:4326").to_file(path)
        return path

    return write


def test_area_selects_the_tiles_of_an_export(town, area, tmp_path):
    west, south, _, _ = town.tiles[0].grid.bounds
    out = tmp_path / "out"
    path = area(west + 5, south + 5, west + 20, south + 20)
    said = call("export", town.path, "--format", "mosaic", "--area", path, "-o", out).expected(0)
    assert "mosaic: 7 files" in said.out
    assert json.loads((out / "export.json").read_text())["tiles"] == 1


def test_area_selects_the_tiles_of_a_run(town, area, tmp_path):
    west, south, _, _ = town.tiles[0].grid.bounds
    path = area(west + 5, south + 5, west + 20, south + 20)
    allow = "--allow", town.path.parent / "survey"
    words = "run", "--catalog", town.path / "catalog.parquet", "--out", tmp_path / "run", "--dry-run"
    said = call(*allow, *words, "--area", path).expected(0)
    assert [line for line in said.out.splitlines() if line.endswith(": new")] == [f"{town.tiles[0].id}: new"]


def test_area_that_cannot_be_used_ends_with_one_line_and_no_output(town, area, tmp_path):
    off, absent, points = area(0, 0, 10, 10), tmp_path / "absent.gpkg", tmp_path / "points.geojson"
    points.write_text('{"type": "Point", "coordinates": [9, 50]}')
    out = tmp_path / "out"
    for path, message in (
        (off, f"no tile touches --area {off}"),
        (absent, "cannot be read"),
        (points, "no polygons"),
    ):
        said = call("export", town.path, "--format", "mosaic", "--area", path, "-o", out).expected(2)
        (line,) = said.errors
        assert message in line
        assert not out.exists()
    said = call("export", town.path, "--format", "mosaic", "--resolution", "0", "-o", out).expected(2)
    assert not out.exists()
