"""Roads of a run as OpenCRG, OpenDRIVE and lines: across tiles, up to their end, after interruptions."""

import csv
import json
import re
import shutil
import subprocess
import warnings
from functools import lru_cache
from xml.etree import ElementTree

import geopandas
import numpy as np
import pytest
import shapely
from pyopencrg import CrgRoad
from pyproj import CRS

import flexroad
from flexroad.pipeline.execute import SerialExecutor
from flexroad.pipeline.run import sampler
from flexroad.pipeline.run.finished import estimate
from flexroad.tools.export.driver import BEGUN, export
from flexroad.tools.export.source import Options, select
from tests import make_roads, validators
from tests.make_city import TILE_M, bend, make_city, south_west, write_lines
from tests.read_exports import spline_heights
from tests.read_opendrive import plan, polynomial, quality_issues
from tests.validators.opendrive import by_carla, by_sumo, in_crs, printed_mm

FORMATS = ["crg", "xodr", "lines"]
ACROSS = bend((10, 20), (190, 80), sag=8)
"""From the south-western tile to the south-eastern one."""
OUT_OF = [(30, 70), (90, 130), (160, 150)]
"""Over the western tiles into the north-eastern one, which is not finished."""

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def city(tmp_path_factory):
    """A run of four tiles, of which the north-eastern one is not computed; its catalog has no roads."""
    return make_city(tmp_path_factory.mktemp("roads"), without=1, roads=False)


@pytest.fixture(scope="module")
def streets(city):
    columns = {"width_m": [6.0, 4.0, 6.0], "lanes": [2, 1, 2], "name": ["Long Street", "Lane", "Short"]}
    return write_lines(city.parent / "streets.gpkg", city, ACROSS, OUT_OF, [(150, 10), (157, 10)], **columns)


@pytest.fixture(scope="module")
def exported(city, streets):
    out = city.parent / "out"
    export(select(city), out, FORMATS, Options(roads=str(streets)), SerialExecutor())
    return out


def surface_heights(city, easting, northing):
    return spline_heights(city, np.column_stack([easting, northing]))


def table(folder):
    with (folder / "roads.csv").open() as file:
        return list(csv.DictReader(file))


def times(folder):
    """Modification time of each file but the manifest, which is always written."""
    files = (path for path in folder.rglob("*") if path.is_file() and path.name != "export.json")
    return {path: path.stat().st_mtime_ns for path in files}


def test_lines_lie_on_the_surface_with_its_grade_and_crossfall(city, exported):
    file = exported / "lines" / "city_roads.gpkg"
    roads = geopandas.read_file(file, layer="roads")
    segments = geopandas.read_file(file, layer="segments")
    assert list(roads["name"]) == ["Long Street", "Lane"]
    assert CRS(roads.crs).to_epsg() == 25832
    for lines in (roads, segments):
        x, y, z = shapely.get_coordinates(lines.geometry.to_numpy(), include_z=True).T
        assert np.abs(z - surface_heights(city, x, y)).max() < 1e-6
    mine = segments[segments.road_id == roads.id[0]].reset_index(drop=True)
    ends = np.array([shapely.get_coordinates(line, include_z=True) for line in mine.geometry])
    step = ends[:, 1] - ends[:, 0]
    length = np.hypot(step[:, 0], step[:, 1])
    np.testing.assert_allclose(length, 1.0, atol=0.002)
    np.testing.assert_allclose(mine.grade_percent, 100 * step[:, 2] / length, atol=0.02)
    # The crossfall is nearly the slope between the edges, and the mean of those to either edge.
    left = np.stack([-step[:, 1], step[:, 0]], axis=1) / length[:, None]
    middle = ends.mean(axis=1)[:, :2]
    edges = [surface_heights(city, *(middle + side * 3.0 * left).T) for side in (1, -1)]
    np.testing.assert_allclose(mine.crossfall_percent, 100 * (edges[0] - edges[1]) / 6, atol=1.5)
    np.testing.assert_allclose(
        (mine.left_percent - mine.right_percent) / 2, 100 * (edges[0] - edges[1]) / 6, atol=0.05
    )
    assert mine.curvature_per_m.abs().max() < 0.1
    assert mine.error_m.notna().all()
    assert 0 < mine.error_m.median() < 0.5
    assert set(mine.height_source) <= {"measured", "dtm", "inferred"}


def test_report_has_the_error_by_elevation_alone_and_wide_roads_are_noted(city, tmp_path):
    columns = {"width_m": [18.0, 16.0], "lanes": [None, 2]}
    wide = write_lines(tmp_path / "wide.gpkg", city, ACROSS, [(30, 70), (90, 95)], **columns)
    formats = export(select(city), tmp_path / "out", ["xodr"], Options(roads=str(wide)), SerialExecutor())
    entry, rows = formats["formats"]["xodr"], table(tmp_path / "out" / "xodr")
    assert [row["lanes"] for row in rows] == ["4", "2"]
    assert "lanes_assumed" not in rows[0]
    for row in rows:
        assert float(row["elevation_max_mm"]) > float(row["profiles_max_mm"])
    assert entry["elevation_max_mm"] == max(float(row["elevation_max_mm"]) for row in rows)
    assert f"by elevation alone (CARLA, SUMO) by {entry['elevation_mean_mm']:.0f} mm" in entry["summary"]
    assert entry["notes"] == [
        "1 road so wide that its lanes are assumed; give the number of lanes"
        f" (road {rows[0]['id']}: 18 m, 4 lanes)",
        "1 road with lanes of less than 2 m or more than 6 m; correct width or number of lanes"
        f" (road {rows[1]['id']}: 16 m, 2 lanes)",
    ]


def test_road_ends_where_the_next_tile_is_not_finished(city, exported):
    lane = geopandas.read_file(exported / "lines" / "city_roads.gpkg", layer="roads").geometry[1]
    x, y = shapely.get_coordinates(lane)[-1] - south_west(city)
    assert TILE_M - 1.5 < x <= TILE_M
    assert y > TILE_M
    lengths = {row["name"]: float(row["length_m"]) for row in table(exported / "crg")}
    assert lengths["Lane"] == pytest.approx(lane.length, abs=1.5)
    summary = json.loads((exported / "export.json").read_text())["formats"]["crg"]
    assert summary["roads"] == 2
    # The road of 7 m, which is too short; the tile that is not finished does not count.
    assert 5 < summary["left_out_m"] < 10


def test_tile_that_failed_in_the_middle_divides_a_road(city, tmp_path):
    around = write_lines(
        tmp_path / "around.gpkg", city, [(20, 195), (95, 160), (130, 130), (150, 95), (190, 20)]
    )
    export(select(city), tmp_path, ["crg", "xodr"], Options(roads=str(around)), SerialExecutor())
    assert [row["id"] for row in table(tmp_path / "crg")] == ["1000", "2000"]
    assert sorted(path.name for path in (tmp_path / "crg").glob("*.crg")) == ["1000.crg", "2000.crg"]
    text = next((tmp_path / "xodr").glob("*.xodr")).read_text()
    assert text.count("<road ") == 2


def test_opencrg_is_within_2_mm_of_the_surface_and_opendrive_within_the_error_of_the_report(city, exported):
    """At random places on the carriageways, by the text of the OpenDRIVE file alone, and by pyopencrg."""
    (file,) = (exported / "xodr").glob("*.xodr")
    rows = {row["id"]: row for row in table(exported / "xodr")}
    roads, rng = ElementTree.parse(file).getroot().findall("road"), np.random.default_rng(0)
    assert len(roads) == 2
    for road in roads:
        row, found = rows[road.attrib["id"]], []
        for s in rng.uniform(0, float(road.attrib["length"]), 1000):
            x, y, heading = plan(road, s)
            t = rng.uniform(-0.5, 0.5) * float(row["width_m"])
            slope = np.tan(polynomial(road, "lateralProfile/superelevation", s))
            height = polynomial(road, "elevationProfile/elevation", s) + t * slope
            found.append((x - t * np.sin(heading), y + t * np.cos(heading), height))
        x, y, height = np.array(found).T
        truth = surface_heights(city, *in_crs(file, "EPSG:25832", x, y))
        crg = CrgRoad.read(exported / "xodr" / road.find("surface/CRG").attrib["file"])
        error = np.abs(crg.xy_to_z(x, y) - truth)
        # A line of OpenDRIVE is up to half a chord longer than that of its OpenCRG.
        assert np.isfinite(error).mean() > 0.98
        assert np.nanmax(error) < 0.002
        error_mm = 1000 * np.abs(height - truth)
        # Between the nodes of the grid it may be a little more than at them.
        assert 5 < np.nanmax(error_mm) < 1.2 * float(row["profiles_max_mm"]) + 2


def test_xodr_passes_the_quality_checker_and_netconvert(exported, tmp_path):
    file = shutil.copy(next((exported / "xodr").glob("*.xodr")), tmp_path / "roads.xodr")
    assert quality_issues(file) == []
    net = tmp_path / "roads.net.xml"
    done = subprocess.run(
        [validators.program("netconvert"), "--opendrive-files", file, "-o", net],
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    # The lanes of two-way roads are edges in either direction.
    assert net.read_text().count("<edge ") >= 2


@pytest.mark.parametrize("program", ["carla", "sumo"])
def test_xodr_in_other_programs_has_the_heights_of_the_surface_within_the_error_of_the_report(
    city, exported, tmp_path, program
):
    """They read no superelevation, so that the error of each road is that by elevation alone."""
    (file,) = (exported / "xodr").glob("*.xodr")
    roads, places = by_carla(file, 0.5) if program == "carla" else by_sumo(file, tmp_path)
    x, y = in_crs(file, "EPSG:25832", *places[:, :2].T)
    smooth = np.abs(places[:, 2] - surface_heights(city, x, y))
    known = np.isfinite(smooth)
    assert known.mean() > 0.95
    query = np.abs(places[:, 2] - flexroad.open_run(city).height(x, y))
    # Where the surface of the tile ends, a place may have no height in one of both.
    known &= np.isfinite(query)
    assert known.sum() > 100
    alone = printed_mm(file.with_name("roads.csv"), "elevation_max_mm")
    steps = printed_mm(file.with_name("roads.csv"), "carriageway_steps_max_mm")
    assert set(roads) == set(alone)
    for road in alone:
        here = known & (roads == road)
        # Coordinates in CARLA have single precision.
        assert 1000 * smooth[here].max() <= alone[road] + 0.1
        assert 1000 * query[here].max() <= alone[road] + steps[road] + 0.1


def test_xodr_refers_to_opencrg_only_if_it_is_written_too(city, streets, exported, tmp_path):
    with_crg = next((exported / "xodr").glob("*.xodr")).read_text()
    assert with_crg.count('file="../crg/') == 2
    export(select(city), tmp_path, ["xodr"], Options(roads=str(streets), left_hand=True), SerialExecutor())
    alone = next((tmp_path / "xodr").glob("*.xodr")).read_text()
    assert "<CRG" not in alone
    assert alone.count('rule="LHT"') == 2
    assert with_crg.count('rule="RHT"') == 2


def test_second_export_writes_nothing_and_other_roads_replace_the_files(city, streets, exported, tmp_path):
    out = shutil.copytree(exported, tmp_path / "out")
    before = times(out)
    export(select(city), out, FORMATS, Options(roads=str(streets)), SerialExecutor())
    assert times(out) == before
    other = write_lines(tmp_path / "other.gpkg", city, bend((20, 10), (80, 190)))
    export(select(city), out, FORMATS, Options(roads=str(other)), SerialExecutor())
    assert [path.name for path in (out / "crg").glob("*.crg")] == ["1000.crg"]
    assert len(geopandas.read_file(out / "lines" / "city_roads.gpkg", layer="roads")) == 1


def test_export_with_few_surfaces_in_memory_is_the_same(city, streets, exported, tmp_path, monkeypatch):
    one = lru_cache(maxsize=1)(sampler.surface_and_road.__wrapped__)
    monkeypatch.setattr(sampler, "surface_and_road", one)
    export(select(city), tmp_path, ["crg"], Options(roads=str(streets)), SerialExecutor())
    for file in (exported / "crg").glob("*.crg"):
        assert (tmp_path / "crg" / file.name).read_bytes() == file.read_bytes()
    assert sampler.surface_and_road.cache_info().currsize == 1


def test_lines_of_a_run_without_its_rasters_have_no_error_estimate(city, streets, exported, tmp_path):
    estimate.cache_clear()  # of the exports before
    rasters = city.parent / "survey"
    rasters.rename(city.parent / "away")
    try:
        export(select(city), tmp_path, ["lines"], Options(roads=str(streets)), SerialExecutor())
    finally:
        (city.parent / "away").rename(rasters)
    segments = geopandas.read_file(tmp_path / "lines" / "city_roads.gpkg", layer="segments")
    before = geopandas.read_file(exported / "lines" / "city_roads.gpkg", layer="segments")
    np.testing.assert_array_equal(segments.height_m, before.height_m)
    assert segments.error_m.isna().all()


def test_roads_in_another_crs_are_the_same_roads(city, streets, exported, tmp_path):
    path = tmp_path / "degrees.geojson"
    geopandas.read_file(streets).to_crs("EPSG:4326").to_file(path)
    export(select(city), tmp_path, ["crg"], Options(roads=str(path)), SerialExecutor())
    for row, other in zip(table(exported / "crg"), table(tmp_path / "crg"), strict=True):
        assert row["name"] == other["name"]
        assert float(row["length_m"]) == pytest.approx(float(other["length_m"]), abs=0.51)


def areas(folder, city):
    return make_roads.write(folder / "areas.gpkg", [shapely.box(*south_west(city), *(south_west(city) + 50))])


def no_crs(folder, city):
    with warnings.catch_warnings(action="ignore", category=UserWarning):
        return make_roads.write(folder / "bare.gpkg", [shapely.LineString([(0, 0), (9, 9)])], crs=None)


def two_layers(folder, city):
    path = write_lines(folder / "two.gpkg", city, ACROSS, layer="streets")
    return write_lines(path, city, ACROSS, layer="rails")


def text(folder, city):
    (folder / "roads.gpkg").write_text("no vectors")
    return folder / "roads.gpkg"


def far(folder, city):
    return write_lines(folder / "far.gpkg", city, [(9000, 0), (9999, 0)])


def short(folder, city):
    return write_lines(folder / "short.gpkg", city, [(50, 50), (55, 50)])


@pytest.mark.parametrize(
    ("make", "options", "message"),
    [
        (None, [], "has no roads: name a file of centre lines with --roads"),
        (lambda folder, city: folder / "none.gpkg", [], "none.gpkg: no such file"),
        (text, [], "roads.gpkg is not a vector file"),
        (no_crs, [], "bare.gpkg carries no CRS; give it one with ogr2ogr -a_srs"),
        (areas, [], "areas.gpkg: 1 area and no line; exports along roads need centre lines"),
        (two_layers, [], "has 2 layers: .*; name one, such as .*streets"),
        (lambda *args: f"{two_layers(*args)}|layername=paths", [], "has no layer 'paths'; it has"),
        (far, [], "far.gpkg: no road lies on the tiles; check the file's CRS and the selected tiles"),
        (short, [], "no road could be written: shorter than 10 m"),
    ],
)
def test_bad_input_is_refused_in_one_line(city, tmp_path, flexroad, make, options, message):
    if make:
        options = ["--roads", str(make(tmp_path, city)), *options]
    out = tmp_path / "out"
    said = flexroad("export", city, "--format", "crg,xodr,lines", "-o", out, *options).expected(2)
    (error,) = said.errors
    assert re.search(message, error)
    files = [path for path in out.rglob("*") if path.is_file() and not path.parent.name.startswith(".")]
    assert [path for path in files if path.name != BEGUN] == []


def test_command_prints_length_and_error_of_the_roads(city, streets, tmp_path, flexroad):
    said = flexroad("export", city, "--format", "crg,xodr,lines", "--roads", streets, "-o", tmp_path)
    lines = said.expected(0).out.splitlines()
    assert lines[0].startswith("crg: 3 files, ")
    assert "2 roads, 0.29 km" in lines[1]
    # The streets are wider than the road of the run, up to its kerbs.
    steps_mm = json.loads((tmp_path / "export.json").read_text())["formats"]["crg"]["crg_steps_max_mm"]
    assert steps_mm > 10
    assert "misses the surface without kerbs and walls by at most" in lines[1]
    assert f"with kerbs and walls it differs by up to {steps_mm / 1000:.2f} m" in lines[1]
    assert "on average" in lines[3]
    assert "without OpenCRG" in lines[3]
