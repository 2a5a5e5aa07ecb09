"""Roads over tiles that do not meet: the step is measured on the carriageway, and the command names it."""

import csv
import json

import numpy as np
import pytest
import shapely

import flexroad
from flexroad.pipeline.run.sampler import length_text
from tests import make_rasters, make_roads

WEST, SOUTH, TILE_M = 499_980, 5_599_980, 60
FORMATS = "crg,xodr,lines"


def level_tiles(folder, config, *heights, tilt=0.0):
    """Return a run of tiles in a row, each of one height, or of a slope from south to north."""
    northward = tilt * np.arange(TILE_M)[::-1, None]
    values = np.hstack([np.full((TILE_M, TILE_M), height) + northward for height in heights])
    folder.mkdir()
    for layer in ("dsm", "dtm"):
        make_rasters.write(folder / f"{layer}.tif", values.astype(np.float32), WEST, SOUTH + TILE_M)
    make_rasters.write(folder / "road.tif", np.ones(values.shape, np.uint8), WEST, SOUTH + TILE_M)
    layers = {"dsm": "dsm.tif", "dtm": "dtm.tif", "road_mask": "road.tif"}
    catalog = flexroad.catalog_from(
        folder, folder / "c.parquet", tile_size_m=TILE_M, road_values=[1], **layers
    )
    run = folder / "run"
    flexroad.run(catalog, config, out=run, workers=1)
    return run


def plane(folder):
    """A configuration whose tiles are planes of their own."""
    path = folder / "plane.yaml"
    path.write_text("extends: paper\nfit: plane\nsample: corners\nvariants: {flexroad: {}}\n")
    return path


def streets(folder, *lines, width_m=6.0):
    shapes = [shapely.LineString(np.add(line, (WEST, SOUTH))) for line in lines]
    names = [f"Street {number}" for number in range(len(lines))]
    return make_roads.write(
        folder / "streets.gpkg", shapes, "EPSG:25832", name=names, width_m=[width_m] * len(lines)
    )


def figures(out):
    """Return the step of each road by its report, and the entries of the manifest."""
    with (out / "crg" / "roads.csv").open() as file:
        steps = [float(row["tile_steps_max_mm"]) for row in csv.DictReader(file)]
    return steps, json.loads((out / "export.json").read_text())["formats"]


def test_road_over_tiles_apart_ends_with_1_and_says_by_how_much(tmp_path, flexroad):
    run = level_tiles(tmp_path / "survey", plane(tmp_path), 100.0, 100.08, 102.0)
    # Two borders, one border, none.
    roads = streets(tmp_path, [(10, 10), (170, 20)], [(70, 40), (10, 42)], [(65, 50), (115, 55)])
    words = ["export", run, "--format", FORMATS, "--roads", roads, "-o", tmp_path / "out"]
    said = flexroad(*words).expected(1)
    steps, entries = figures(tmp_path / "out")
    assert steps == pytest.approx([1920, 80, 0], abs=0.01)
    for name in FORMATS.split(","):
        assert entries[name]["tile_steps_max_mm"] == pytest.approx(1920, abs=0.01)
    lines = [line for line in said.err.splitlines() if line.startswith("error: ")]
    assert lines == [
        f"error: {name}: 2 roads lie on tiles that do not meet (road 1000 Street 0: 1.92 m, road 2000 Street "
        "1: 80 mm); use a run of production, whose tiles have common borders"
        for name in FORMATS.split(",")
    ]
    assert "misses the surface by at most 9" in said.out
    allowed = flexroad(*words, "--allow-steps").expected(0)
    assert "note: crg: 2 roads lie on tiles that do not meet" in allowed.err
    crossing, inside = (f"{WEST + west} {SOUTH + 10}, {WEST + 110} {SOUTH + 10}" for west in (10, 70))
    said = flexroad("query", run, "--line", crossing, "--step", 25).expected(0)
    assert "note: the line crosses tiles that do not meet, by up to 80 mm; use a run of prod" in said.err
    assert flexroad("query", run, "--line", inside, "--step", 25).expected(0).err == ""


def test_step_beside_a_road_along_a_border_counts_on_its_carriageway_alone(tmp_path, flexroad):
    run = level_tiles(tmp_path / "survey", plane(tmp_path), 100.0, 101.0)
    for x, step in ((58.0, 1000), (56.5, 0)):
        roads = streets(tmp_path, [(x, 10), (x, 50)])
        out = tmp_path / f"out{x}"
        said = flexroad("export", run, "--format", "crg", "--roads", roads, "-o", out)
        assert said.code == (step > 0)
        assert figures(out)[0] == pytest.approx([step], abs=0.01)


def test_production_carries_a_road_over_the_same_ground(tmp_path, flexroad):
    run = level_tiles(tmp_path / "survey", "production", 100.0, 100.08, 102.0)
    roads = streets(tmp_path, [(10, 10), (170, 20)])
    flexroad("export", run, "--format", FORMATS, "--roads", roads, "-o", tmp_path / "out").expected(0)
    steps, entries = figures(tmp_path / "out")
    assert steps == pytest.approx([0], abs=0.001)
    error = entries["xodr"]["profiles_max_mm"]
    assert f"on average, at most {error:.0f} mm, without OpenCRG" in entries["xodr"]["summary"]


def test_lift_onto_tiles_apart_ends_with_1_and_says_by_how_much(tmp_path, flexroad):
    run = level_tiles(tmp_path / "survey", plane(tmp_path), 100.0, 102.0)
    for line, code in (([(10, 10), (110, 20)], 1), ([(70, 10), (110, 20)], 0)):
        roads = streets(tmp_path, line)
        words = ["lift", roads, run, "-o", tmp_path / "lifted.gpkg"]
        said = flexroad(*words).expected(code)
        assert ("it lies on tiles that do not meet, by up to 2.00 m; use a run of" in said.err) == (code > 0)
        assert "note: " in flexroad(*words, "--allow-steps").expected(0).err or not code


def test_small_step_is_fit_for_roads_and_noted_for_meshes(tmp_path, flexroad):
    run = level_tiles(tmp_path / "survey", plane(tmp_path), 100.0, 100.04)
    roads = streets(tmp_path, [(10, 10), (110, 20)])
    words = "export", run, "-o", tmp_path / "out", "--format"
    flexroad(*words, FORMATS, "--roads", roads).expected(0)
    steps, entries = figures(tmp_path / "out")
    assert steps == pytest.approx([40], abs=0.01)
    assert entries["lines"]["tile_steps_max_mm"] == pytest.approx(40, abs=0.01)
    said = flexroad(*words, "mosaic,obj").expected(0)
    assert "note: mosaic, obj: the tiles of this run do not meet, and heights have steps there" in said.err


@pytest.mark.parametrize(("length", "text"), [(0.00004, "0.0 mm"), (0.226, "226.0 mm"), (8.3841, "8.38 m")])
def test_length_is_in_a_sensible_unit(length, text):
    assert length_text(length, 1) == text
