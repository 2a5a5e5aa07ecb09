"""Rasters of synthetic clouds have the true heights, whatever the division into files, blocks and units."""

import resource
from datetime import UTC, date, datetime
from pathlib import Path

import laspy
import numpy as np
import pytest
import rasterio

from flexroad.catalog import Catalog, CatalogError, Grid
from flexroad.catalog.crs import vertical
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.execute import SerialExecutor
from flexroad.tasks.io.dsm_and_dtm import vertical_crs
from flexroad.tasks.load import Options as LoadOptions
from flexroad.tasks.load import load
from flexroad.tools.prepare import point_buckets, point_reading
from flexroad.tools.prepare.from_points import prepare_points
from flexroad.tools.prepare.options import PrepareOptions
from flexroad.tools.prepare.points.binning import Points
from flexroad.tools.prepare.points.to_rasters import Options
from tests.make_clouds import rasterise, write_cloud

SIZE = np.array([130.0, 90.0])
"""Size of the synthetic ground (m); its south-west corner is at whole metres."""
WITHIN = 0.011
"""Tolerance (m): heights are stored in centimetres or hundredths of a foot."""
DECK_M, HOUSE_M, CAR_M = 6.0, 8.0, 1.5


def ground(east, north):
    """Height of a tilted plane (m); east and north are metres from the corner."""
    return 50 + 0.08 * east - 0.05 * north


def world(unit=1.0, corner=(356010.0, 5699870.0)):
    """Coordinates in `unit`, classes and colours: a plane with a house, cars, a bridge and noise."""
    rng = np.random.default_rng(1)
    plan = rng.uniform(0.02, SIZE - 0.02, (60_000, 2))
    east, north = plan.T
    kind = np.full(len(plan), 2, np.uint8)
    height = ground(east, north)
    house = (abs(east - 30) < 12) & (abs(north - 40) < 9)
    deck = abs(north - 70) < 4
    car = (abs(east % 20 - 10) < 1) & (abs(north - 15) < 2)
    for mask, class_, above in ((house, 6, HOUSE_M), (deck, 17, DECK_M), (car, 1, CAR_M)):
        kind[mask], height[mask] = class_, height[mask] + above
    noise = rng.choice(len(plan), 40, replace=False)
    kind[noise], height[noise] = rng.choice([7, 18], 40), height[noise] + 90
    colour = np.stack([east, north, kind * 10.0], axis=1).astype(np.uint8)
    xyz = np.stack([east + corner[0], north + corner[1], height], axis=1) / unit
    return np.round(xyz, 2), kind, colour


def two_files(folder: Path, *, crs="EPSG:25832", suffix="laz", swap=False, **world_options) -> list[Path]:
    """Write the points of `world` to two files that overlap in a strip, without duplicate points."""
    xyz, kind, colour = world(**world_options)
    middle = np.median(xyz[:, 0])
    even = np.arange(len(xyz)) % 2 == 0
    strip = abs(xyz[:, 0] - middle) < 10
    left = (xyz[:, 0] < middle - 10) | (strip & even)
    names = ("b", "a") if swap else ("a", "b")
    order = np.random.default_rng(2 + swap).permutation(len(xyz))
    paths = []
    for name, members in zip(names, (left, ~left), strict=True):
        chosen = order[members[order]]
        shade = colour[chosen].astype(np.uint16) << 8
        paths.append(write_cloud(folder / f"{name}.{suffix}", xyz[chosen], kind[chosen], crs, shade))
    return paths


def prepare(files, out, executor=None, ground="auto", options=None, **common):
    lines = []
    executor, options = executor or SerialExecutor(), options or Options()
    result = prepare_points(files, out, PrepareOptions(**common), options, executor, lines.append, ground)
    return result, lines


def read(folder, layer):
    with rasterio.open(folder / f"{layer}.tif") as raster:
        return raster.read(masked=layer == "dop").squeeze(), raster


def highest(xyz, kind, raster):
    """Highest point per cell, by a plain loop over the points."""
    top = np.full(raster.shape, np.nan)
    for (x, y, z), k in zip(xyz, kind, strict=True):
        row = int(np.floor(raster.bounds.top - y))
        col = int(np.floor(x - raster.bounds.left))
        if k not in (7, 18):
            top[row, col] = np.fmax(top[row, col], z)
    return top


@pytest.mark.parametrize(
    ("unit", "crs", "metric", "corner"),
    [
        (1.0, "EPSG:25832", "EPSG:25832", (356010.0, 5699870.0)),
        (0.3048, "EPSG:2994", "EPSG:2993", (194010.0, 259870.0)),
    ],
)
def test_prepare_points_gives_true_heights(tmp_path, unit, crs, metric, corner):
    files = two_files(tmp_path, crs=crs, unit=unit, corner=corner)
    result, _ = prepare(files, tmp_path / "out", roads=None)
    xyz, kind, _ = world(unit, corner)
    dsm, raster = read(tmp_path / "out", "dsm")
    assert raster.crs == metric
    # Points rounded to hundredths of a foot may move to the next cell.
    slack = 0 if unit == 1 else 1
    left, bottom, right, top = raster.bounds
    assert np.abs([left - corner[0], bottom - corner[1]]).max() <= slack
    assert np.abs([right - corner[0] - SIZE[0], top - corner[1] - SIZE[1]]).max() <= slack
    truth = highest(np.round(xyz * unit, 4), kind, raster)
    valid = np.isfinite(truth)
    assert valid.mean() > 0.95
    assert np.abs(dsm - truth)[valid].max() < 1e-4
    assert np.isfinite(dsm).all()
    check_road_height(tmp_path / "out", dsm)

    dtm, _ = read(tmp_path / "out", "dtm")
    rows, cols = np.indices(dtm.shape)
    plane = ground(left + cols + 0.5 - corner[0], top - rows - 0.5 - corner[1])
    inner = (slice(2, -2), slice(2, -2))
    assert np.abs(dtm - plane)[inner].max() < WITHIN

    (tile,) = Catalog.read(result.catalog).tiles
    data = load(tile, LoadOptions())
    deck = np.isfinite(read(tmp_path / "out", "bridges")[0])
    assert deck.any()
    # The deck height of a cell is the mean of its points, not the height at its centre.
    assert np.abs(data.reference - plane - DECK_M)[deck].max() < 0.08 + WITHIN
    assert np.array_equal(data.reference[~deck], data.dtm[~deck])


def check_road_height(out, dsm):
    with rasterio.open(out / "road_height.tif") as file:
        height, count, spread = file.read()
        assert file.descriptions == ("height", "count", "spread")
        assert file.units == ("m", None, "m")
        assert file.tags()["LAYER"] == "road_height"
    below = dsm - height
    assert below.min() > -1e-4
    assert below.max() < 0.25
    assert np.array_equal(np.isnan(spread), count == 0)
    assert np.abs(below[count == 1]).max() < 1e-4
    assert (below[count > 5] > 0).mean() > 0.9


@pytest.mark.parametrize(
    ("colours", "expected"),
    [
        ([0, 200, 60_000, 9], [0, 200, 255, 9]),
        ([0, 60_000, 200, 9], [0, 60_000 >> 8, 0, 0]),
        ([0, 0, 0, 9], [0, 0, 0, 9]),
    ],
)
def test_first_chunk_with_colours_decides_on_their_bits(tmp_path, monkeypatch, executor, colours, expected):
    """A chunk of equal colours per column of the orthophoto, west to east."""
    monkeypatch.setattr(point_reading, "CHUNK", 100)
    north, column = np.arange(100) / 10, np.arange(4).repeat(100)
    xyz = np.stack([356_000.5 + column, 5_699_000 + np.tile(north, 4), np.full(400, 50.0)], axis=1)
    colour = np.repeat(np.array(colours), 100)[:, None].repeat(3, axis=1)
    file = write_cloud(tmp_path / "a.las", xyz, 2, "EPSG:25832", colour)
    prepare([file], tmp_path / "out", executor, dop_cell_m=1.0)
    photo, _ = read(tmp_path / "out", "dop")
    if any(colours):
        np.testing.assert_array_equal(photo.data[:, 2], [expected] * 3)


def test_points_that_a_dead_worker_has_written_are_written_once(plain, tmp_path, monkeypatch):
    def twice(self, function, jobs, lost, probe=None):
        for job in jobs:
            function(job)
            yield function(job)

    monkeypatch.setattr(SerialExecutor, "map", twice)
    prepare(plain[0], tmp_path / "out", ground="filter")
    check_same(tmp_path / "out", plain[1])


@pytest.fixture(scope="module")
def plain(tmp_path_factory):
    folder = tmp_path_factory.mktemp("plain")
    files = two_files(folder)
    prepare(files, folder / "out", ground="filter")
    return files, {layer: read(folder / "out", layer)[0] for layer in ("dsm", "dtm", "bridges", "dop")}


def check_same(out, expected):
    for layer in ("dsm", "bridges", "dop"):
        assert np.array_equal(read(out, layer)[0], expected[layer], equal_nan=layer != "dop"), layer
    assert np.allclose(read(out, "dtm")[0], expected["dtm"], rtol=0, atol=1e-5, equal_nan=True)


def test_prepare_points_in_other_order_and_small_chunks_gives_the_same_rasters(plain, tmp_path, monkeypatch):
    """Both the files and the points within them are in another order; some heights are out of range."""
    monkeypatch.setattr(point_reading, "CHUNK", 997)
    two_files(tmp_path / "clouds", swap=True)
    xyz, *_ = world()
    far_below = np.column_stack([xyz[:3, :2], np.full(3, -32767)])
    write_cloud(tmp_path / "clouds" / "c.laz", far_below, 2, "EPSG:25832", np.full((3, 3), 60_000))
    result, _ = prepare([tmp_path / "clouds"], tmp_path / "out", ground="filter")
    check_same(tmp_path / "out", plain[1])
    assert "left out 3 points with heights outside -500..9000 m; check --height-unit" in result.notes


@pytest.mark.parametrize("despike_m", [None, 5])
def test_prepare_points_in_blocks_gives_the_rasters_of_all_points_at_once(tmp_path, monkeypatch, despike_m):
    """Points on the borders of cells, blocks and the area; voids and spikes at the borders of blocks."""
    monkeypatch.setattr(point_buckets, "POINTS_PER_BLOCK", 1)
    monkeypatch.setattr(point_buckets, "SHORTEST_EDGE_M", 37.0)
    rng = np.random.default_rng(8)
    east, north = (axis.ravel() for axis in np.meshgrid(np.arange(0, 90.5, 0.5), np.arange(0, 90.5, 0.5)))
    xyz = np.stack(
        [east + 356e3, north + 5699e3, ground(east, north) + rng.normal(0, 0.1, east.size)], axis=1
    )
    xyz[:, 2] = np.round(xyz[:, 2] + 20 * (rng.random(east.size) < 0.01), 2)
    xyz = xyz[(abs(east % 37) > 2) | (north % 30 > 4)]
    kind = rng.choice([2, 5, 17], len(xyz), p=[0.6, 0.3, 0.1]).astype(np.uint8)
    colour = rng.integers(0, 256, (len(xyz), 3)).astype(np.uint16)
    options = Options(despike_m=despike_m, void_m=6, fill_m=2)
    file = write_cloud(tmp_path / "a.las", xyz, kind, "EPSG:25832", colour)
    _, lines = prepare([file], tmp_path / "out", options=options, ground="classes")
    assert any(line.endswith(" blocks of 37 m") for line in lines)
    area = Grid("EPSG:25832", 356e3, 5699090.0, 1.0, 90, 90)
    whole = rasterise(Points(*xyz.T, kind, colour.astype(np.uint8)), area, options, 0.5)
    for layer in ("dsm", "dtm", "bridges"):
        np.testing.assert_array_equal(
            read(tmp_path / "out", layer)[0], getattr(whole, layer).astype(np.float32)
        )
    top = np.stack([whole.top.height, whole.top.count, whole.top.spread]).astype(np.float32)
    np.testing.assert_array_equal(read(tmp_path / "out", "road_height")[0], top)
    np.testing.assert_array_equal(read(tmp_path / "out", "dop")[0].filled(0), whole.photo.colour)


def test_prepare_points_with_workers_gives_the_same_rasters(plain, tmp_path, monkeypatch, executor):
    monkeypatch.setattr(point_buckets, "POINTS_PER_BLOCK", 1)
    # A compressed file is divided where its chunks of 50,000 points are, so that it has one part.
    monkeypatch.setattr(point_reading, "CHUNK", 7000)
    files = [laspy.read(file) for file in plain[0]]
    for file in files:
        file.write(tmp_path / f"{len(file)}.las")
    _, lines = prepare(sorted(tmp_path.glob("*.las")), tmp_path / "out", executor, ground="filter")
    assert sum(line.startswith("reading ") for line in lines) == len(files)
    check_same(tmp_path / "out", plain[1])
    names = {path.name for path in (tmp_path / "out").iterdir()}
    rasters = {f"{name}.tif" for name in ("dsm", "dtm", "road_height", "bridges", "dop")}
    assert names == {*rasters, "catalog.parquet"}


def test_prepare_points_ground_is_identified_as_asked_and_auto_by_classes_if_present(tmp_path):
    xyz, kind, _ = world()
    crs = "EPSG:25832"
    flat = {name: write_cloud(tmp_path / f"{name}.laz", xyz, k, crs) for name, k in
            [("good", kind), ("alike", 1), ("few", np.where(np.arange(len(kind)) % 150, 1, 2))]}  # fmt: skip

    def method(*names, ground="auto"):
        result, _ = prepare([flat[name] for name in names], tmp_path / "out", ground=ground)
        with rasterio.open(tmp_path / "out" / "dtm.tif") as dtm:
            processing = dtm.tags()["DTM"]
        return processing, " ".join(result.notes)

    by_class, by_slope = " of points of class 2;", " of slope-filtered points "
    assert by_class in method("good")[0]
    assert by_slope in method("good", ground="filter")[0]
    assert " of morphologically filtered points " in method("good", ground="morphological")[0]
    processing, notes = method("good", "alike")
    assert by_slope in processing
    assert "all points of alike.laz have the same class: ground is identified by the slope filter" in notes
    processing, notes = method("few")
    assert by_slope in processing
    assert "less than 1% of the points of few.laz are ground (class 2)" in notes
    assert by_class in method("few", ground="classes")[0]
    assert "no orthophoto: no colours in few.laz" in notes
    with pytest.raises(CatalogError, match="no point of class 2 in .*alike.laz; leave --ground classes out"):
        method("alike", ground="classes")


def test_prepare_points_dense_noisy_cloud_gives_unbiased_ground(tmp_path):
    """At 100 points per m2 almost every point has a neighbour that is lower by three sigma."""
    rng = np.random.default_rng(3)
    xyz = np.column_stack(
        [rng.uniform(0, 40, (160_000, 2)) + np.array([356e3, 5699e3]), rng.normal(50, 0.05, 160_000)]
    )
    result, _ = prepare([write_cloud(tmp_path / "dense.laz", xyz, 0, "EPSG:25832")], tmp_path / "out")
    dtm, _ = read(tmp_path / "out", "dtm")
    assert any("100 points per m2" in note for note in result.notes)
    assert abs(np.nanmedian(dtm) - 50) < 0.01


@pytest.fixture(scope="module")
def bad_inputs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("bad")
    xyz, kind, _ = world()
    crs = "EPSG:25832"
    good = write_cloud(folder / "good.laz", xyz, kind, crs)
    cut = folder / "cut.laz"
    cut.write_bytes(good.read_bytes()[:100_000])
    las = write_cloud(folder / "cut.las", xyz, kind, crs)
    las.write_bytes(las.read_bytes()[:-31])
    empty = write_cloud(folder / "empty.laz", np.zeros((0, 3)), crs=crs)
    distant = np.vstack([xyz[:10], xyz[0] + np.array([9e6, 9e6, 0])])
    return {
        "missing": ([folder / "none.laz"], {}, "none.laz does not exist"),
        "empty": ([good, empty], {}, "empty.laz has no points; leave it out"),
        "cut_laz": ([good, cut], {}, "cut.laz cannot be read as a point cloud.*download it again"),
        "cut_las": ([good, las], {}, "cut.las is cut short: .* download it again"),
        "no_crs": ([good, write_cloud(folder / "bare.laz", xyz)], {}, "bare.laz carries no CRS; .* --crs"),
        "mixed": (
            [good, write_cloud(folder / "feet.laz", xyz, kind, "EPSG:2994")], {},
            "mixed CRS: .*feet.laz is in EPSG:2994, .*good.laz in EPSG:25832",
        ),
        "contradicted": ([good], {"crs": "EPSG:2994"}, "good.laz is in .*25832, --crs in EPSG:2994; leave"),
        "noise": ([write_cloud(folder / "noise.laz", xyz, 7, crs)], {}, "noise.laz has only noise points"),
        "far": ([write_cloud(folder / "far.laz", distant, 2, crs)], {}, "far.laz has a point at easting 93"),
        "mercator": (
            [write_cloud(folder / "web.laz", xyz, kind, "EPSG:3857")], {},
            r"^the rasters: a metre of EPSG:3857 is 0.7 m .*; give a CRS in metres with --to-crs EPSG:32631$",
        ),
        "cells": ([good], {"cell_m": 1.0, "dop_cell_m": 0.3}, "--dop-cell 0.3: one must be a multiple"),
        "unit": ([good], {"height_unit": "yard"}, "--height-unit yard: must be one of metre, foot, us-foot"),
        "target": ([good], {"to_crs": "EPSG:4326"}, "--to-crs EPSG:4326 is in degrees"),
    }  # fmt: skip


BAD = "missing empty cut_laz cut_las no_crs mixed contradicted noise far mercator cells unit target"


@pytest.mark.parametrize("name", BAD.split())
def test_prepare_points_invalid_input_is_one_line_and_leaves_no_folder(bad_inputs, tmp_path, name):
    files, options, message = bad_inputs[name]
    with pytest.raises((CatalogError, ConfigError), match=message) as error:
        prepare(files, tmp_path / "out", **options)
    assert "\n" not in str(error.value)
    assert not (tmp_path / "out").exists()


def test_prepare_points_full_disk_is_one_line_and_keeps_existing_files(tmp_path):
    files = two_files(tmp_path)
    prepare(files, tmp_path / "out")
    before = {path: path.read_bytes() for path in (tmp_path / "out").iterdir()}
    unlimited = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (300_000, unlimited[1]))
    try:
        with pytest.raises(ConfigError, match="cannot write to .*out: File too large; correct that"):
            prepare(files, tmp_path / "out")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, unlimited)
    assert {path: path.read_bytes() for path in (tmp_path / "out").iterdir()} == before


@pytest.mark.parametrize(
    ("crs", "datum"),
    [("EPSG:25832+7837", 7837), ("EPSG:2994+8228", 5703), ("EPSG:25832", None)],
    ids=["metres", "feet", "unknown"],
)
def test_prepare_points_writes_the_vertical_crs_of_its_points(tmp_path, crs, datum):
    places = np.add(np.argwhere(np.ones((60, 60))), (640_000, 860_000))
    files = [write_cloud(tmp_path / "a.laz", np.column_stack([places, np.full(3600, 30.0)]), 2, crs)]
    catalog = prepare(files, tmp_path / "out")[0].catalog
    for layer in ("dsm", "dtm"):
        with rasterio.open(tmp_path / "out" / f"{layer}.tif") as raster:
            assert vertical(raster.crs.to_wkt()) == (datum and f"EPSG:{datum}")
    (tile,) = Catalog.read(catalog).tiles
    assert tile.grid.crs in ("EPSG:25832", "EPSG:2993")
    assert vertical_crs(tile) == (datum and f"EPSG:{datum}")
    height = 30 * (0.3048 if crs.startswith("EPSG:2994") else 1)
    np.testing.assert_allclose(np.nanmedian(load(tile, LoadOptions()).dsm), height, atol=WITHIN)


FLOWN = (datetime(2019, 4, 3, 9, tzinfo=UTC) - datetime(1980, 1, 6, tzinfo=UTC)).total_seconds() - 1e9
"""Adjusted standard GPS time of a flight, without leap seconds."""


def flight(path, **options):
    """Write a plane of 40 x 40 m."""
    east, north = np.meshgrid(np.arange(0, 40, 0.5), np.arange(0, 40, 0.5))
    xyz = np.stack([east + 356_000.1, north + 5_699_000.1, ground(east, north)], axis=-1)
    return write_cloud(path, xyz.reshape(-1, 3), 2, "EPSG:25832", created=date(2021, 6, 7), **options)


@pytest.mark.parametrize(
    ("options", "expected", "assumed"),
    [
        ({"gps": FLOWN, "standard": True}, "2019-04-03", False),
        ({"gps": 300_000.0}, "2021-06-07", True),
        ({"gps": 300_000.0, "standard": True}, "2021-06-07", True),
        ({"gps": 0.0, "standard": True}, "2021-06-07", True),
        ({"gps": -1e9, "standard": True}, "2021-06-07", True),
        ({"gps": 5e9, "standard": True}, "2021-06-07", True),
        ({}, "2021-06-07", True),
    ],
)
def test_date_is_that_of_the_points_else_of_the_header(tmp_path, options, expected, assumed):
    """Standard GPS times are dates; seconds of a week are no dates, even if the header says so."""
    result, _ = prepare([flight(tmp_path / "a.las", **options)], tmp_path / "out")
    (tile,) = Catalog.read(result.catalog).tiles
    assert (f"{tile.datetime:%Y-%m-%d}", tile.datetime_assumed) == (expected, assumed)
    assert any(expected in note and ("--date sets it" in note) == assumed for note in result.notes)


def test_date_of_several_flights_is_the_first_and_option_goes_before(tmp_path):
    files = [flight(tmp_path / f"{day}.laz", gps=FLOWN + day * 86_400, standard=True) for day in (2, 0, 5)]
    undated = flight(tmp_path / "undated.las")

    def dates(files, **options):
        result, _ = prepare(files, tmp_path / "out", tile_size_m=20, **options)
        tiles = Catalog.read(result.catalog).tiles
        assert len(tiles) > 1
        return {(f"{tile.datetime:%Y-%m-%d}", tile.datetime_assumed) for tile in tiles}, result.notes

    found, notes = dates(files)
    assert found == {("2019-04-03", False)}
    assert "date of the survey: 2019-04-03 to 2019-04-08, by GPS time" in notes
    assert dates(files, date=datetime(2020, 5, 1))[0] == {("2020-05-01", False)}
    # It is only assumed if one file has none.
    assert dates([files[1], undated])[0] == {("2021-06-07", True)}


@pytest.mark.parametrize(
    ("class_", "classes", "is_bridge"),
    [
        (26, None, False),
        (26, (26,), True),
        (26, (17, 26), True),
        (26, (17,), False),
        (17, (26,), False),
        (17, (17, 26), True),
    ],
)
def test_decks_are_bridges_only_if_their_class_is_told(tmp_path, class_, classes, is_bridge):
    """A deck, 6 m above the ground. Its class in AHN is 26."""
    xyz, kind, _ = world()
    path = write_cloud(tmp_path / "a.las", xyz, np.where(kind == 17, class_, kind), "EPSG:25832")
    options = Options() if classes is None else Options(bridge_classes=classes)
    result, _ = prepare([path], tmp_path / "out", options=options)
    assert (tmp_path / "out" / "bridges.tif").is_file() == is_bridge
    noted = [note for note in result.notes if "--bridge-class" in note]
    assert len(noted) == (not is_bridge)
    for note in noted:
        assert f"{(kind == 17).sum():,} points of class {class_}" in note
        assert f"--bridge-class {class_}" in note
