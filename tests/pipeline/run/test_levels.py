"""A run over roads above roads: two heights at one place, and neighbours that meet on every level."""

import io
import json
import subprocess
from dataclasses import replace
from xml.etree import ElementTree

import geopandas
import numpy as np
import pandas as pd
import pytest
import rasterio
import shapely
import trimesh

import flexroad
from flexroad.catalog import Catalog
from flexroad.catalog.grid import Grid
from flexroad.pipeline.config.loading import load_config
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.execute import DaskExecutor, SerialExecutor
from flexroad.pipeline.run.cleanup import find_garbage
from flexroad.pipeline.run.finished import FinishedTile
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.run.runner import run_tiles
from flexroad.pipeline.run.sampler import RunSampler, on_levels
from flexroad.pipeline.run.status import peek_statuses
from flexroad.tasks.levels.along_route import PlaceLevels
from flexroad.tasks.products import npz
from flexroad.tasks.quality.height_source import HeightSource
from flexroad.tasks.spline.levelled import LevelledSurface
from flexroad.tools.synthetic.crossings import CROSS_M, MAIN_M, Crossings
from flexroad.tools.synthetic.scene import MAIN, SIDE
from flexroad.tools.synthetic.scenes import write_scenes
from flexroad.tools.view.driver import write_viewer
from tests import validators
from tests.command_line import call
from tests.mesh_union import Union
from tests.read_exports import on_mesh
from tests.read_opendrive import numbers, plan, polynomial, quality_issues
from tests.tasks.spline.test_levelled import GRID, SOUTH, WEST, made_surface
from tests.tools.view.test_encoding import content, heights
from tests.validators.gltf import gltf_issues
from tests.validators.opendrive import by_sumo, in_crs

SEED, SIZE_M = 0, 60
WITH_LEVELS = ["segment.levels=true"]


def made(folder, executor, settings=WITH_LEVELS):
    catalog = Catalog.read(write_scenes(folder / "survey", 4, seed=SEED, size_m=SIZE_M, decks=True))
    run = Run.create(folder / "run", load_config("production_vector", settings), catalog)
    summary = run_tiles(run, executor)
    assert (summary.done, summary.failed) == (4, 0)
    return run


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return made(tmp_path_factory.mktemp("levels"), SerialExecutor())


def finished(run):
    statuses = peek_statuses(run, run.catalog.tiles)
    return [FinishedTile.of(run, status, run.config.export.variants[0]) for status in statuses]


@pytest.fixture(scope="module")
def cells(run):
    """Cell centres of the tiles, and the true heights of level 0 and 1 there."""
    west, south, east, north = flexroad.open_run(run.path).tiles.total_bounds
    grid = Grid("EPSG:25832", west, north, 1.0, round(east - west), round(north - south))
    at = np.meshgrid(grid.eastings, grid.northings)
    world = Crossings(SEED)
    return (*at, world.height(0, *at), world.height(1, *at))


def test_heights_and_normals_are_those_of_the_level_that_is_asked_for(run, cells):
    x, y, low, deck = cells
    view = flexroad.open_run(run.path)
    ground, above, top = view.height(x, y, 0), view.height(x, y, level=1), view.height(x, y)
    on = np.isfinite(above)
    assert on.sum() > 100
    assert np.isnan(deck[on]).sum() == 0
    assert np.abs(above - deck)[on].mean() < 0.02
    assert np.abs(ground - low)[on].mean() < 0.5
    np.testing.assert_array_equal(top, np.where(on, above, ground))
    assert np.isnan(view.height(x, y, 2)).all()
    assert view.height(x, y, -1).shape == x.shape
    assert view.normal(x, y)[on, 2].min() > 0.98


def test_query_has_a_row_for_each_level(run, cells, tmp_path):
    x, y, low, deck = cells
    on = np.isfinite(flexroad.open_run(run.path).height(x, y, 1))
    high, beside = on & (deck - low > 4), (x[~on][:1], y[~on][:1])
    places = np.column_stack([x[high][:3], y[high][:3]])
    table = pd.DataFrame(np.vstack([places, np.column_stack(beside)]), columns=["easting", "northing"])
    table.to_csv(tmp_path / "points.csv", index=False)

    def query(*words):
        said = call("query", run.path, "--points", tmp_path / "points.csv", *words).expected(0)
        return pd.read_csv(io.StringIO(said.out)), said.err

    every, _ = query("--level", "all")
    assert every.level.tolist() == [0, 1, 0, 1, 0, 1, 0]
    assert (every["class"][every.level == 1] == "road").all()
    below, above = (query("--level", number)[0] for number in (0, 1))
    assert (above.height_m[:3] - below.height_m[:3] > 3).all()
    assert np.isnan(above.height_m[3])
    top, notes = query()
    assert "level" not in top
    np.testing.assert_array_equal(top.height_m[:3], above.height_m[:3])
    assert "lies on no road of level 1" in query("--level", 1)[1]
    assert not notes
    wrong = call("query", run.path, "--points", tmp_path / "points.csv", "--level", "top").expected(2)
    assert "--level top: give a whole number, such as 0, or all" in wrong.err


def test_profile_below_a_deck_has_the_grade_of_its_level(run, cells):
    x, y, *_ = cells
    on = np.isfinite(flexroad.open_run(run.path).height(x, y, 1))
    east, north = x[on].mean(), y[on].mean()
    line = f"{east - 4} {north}, {east + 4} {north}"
    table = pd.read_csv(io.StringIO(call("query", run.path, "--line", line, "--level", "all").out))
    assert set(table.level) == {0, 1}
    assert table[table.level == 1].grade_percent.abs().max() < 15


def test_rasters_and_archives_have_the_levels(run, cells):
    """Rasters show the highest level; the ground below decks has rasters of its own."""
    x, y, *_ = cells
    view = flexroad.open_run(run.path)
    levelled = 0
    for tile in finished(run):
        folder = run.folder(tile.id).path
        surface = npz.decode(folder / f"{tile.id}_flexroad_surface.npz")
        at = np.meshgrid(tile.tile.grid.eastings, tile.tile.grid.northings)
        with rasterio.open(folder / f"{tile.id}_flexroad_height.tif") as raster:
            np.testing.assert_allclose(raster.read(1), view.height(*at), atol=1e-4)
        if isinstance(surface, LevelledSurface):
            levelled += 1
            np.testing.assert_array_equal(surface.height(*at), view.height(*at, 0))
        item = json.loads((folder / "item.json").read_bytes())
        for name in ("height_level0", "height_source_level0"):
            assert (name in item["assets"]) == (1 in tile.mesh.numbers)
    assert levelled > 0
    with rasterio.open(run.path / "height.vrt") as top, rasterio.open(run.path / "height_level0.vrt") as low:
        np.testing.assert_allclose(top.read(1), view.height(x, y), atol=1e-4)
        np.testing.assert_allclose(low.read(1), view.height(x, y, 0), atol=1e-4)
    with rasterio.open(run.path / "height_source.vrt") as file:
        deck = file.read(1)[np.isfinite(view.height(x, y, 1))]
    assert (deck == HeightSource.MEASURED).mean() > 0.5
    assert (deck != HeightSource.NONE).all()
    assert "height_level0" in json.loads((run.path / "collection.json").read_bytes())["assets"]
    assert [waste.path.name for waste in find_garbage([run]) if waste.kind == "products"] == []


def test_quality_of_tiles_with_decks_has_no_flags(run):
    metrics = flexroad.open_run(run.path).metrics
    assert set(metrics["flags"]) == {"", "no-road"}
    assert metrics.inferred_road.max() > 0.05
    assert metrics.l2_road_m.max() < 0.03


def test_decks_have_figures_in_a_table_and_in_the_report(run):
    table = pd.read_csv(run.path / "levels.csv")
    tiles = {tile.tile.id: tile for tile in finished(run)}
    assert set(table.tile_id) == {name for name, tile in tiles.items() if 1 in tile.mesh.numbers}
    assert set(table.level) == {1}
    for row in table.itertuples():
        mesh = tiles[row.tile_id].mesh.at(1)
        area = shapely.area(shapely.polygons(mesh.vertices[mesh.faces][:, :, :2])).sum()
        assert row.area_m2 == pytest.approx(area, abs=0.5)
    assert table.abutments.sum() == 2
    assert table.clearance_m.max() > 5
    assert table.error_estimate_m.max() < 0.05
    assert table["flags"].isna().all()
    call("report", run.path).expected(0)
    _, _, decks = (run.path / "report.md").read_text().partition("## Decks and tunnels")
    assert "| tile | level | area (m²) | abutments | clearance (m) |" in decks


def test_viewer_has_heights_and_estimates_of_the_highest_level(run, tmp_path):
    write_viewer(run, tmp_path, SerialExecutor())
    index = (tmp_path / "run.js").read_text()
    assert json.loads(index[index.index("(") + 1 : index.rindex(")")])["levels"] is True
    view, on_decks = flexroad.open_run(run.path), []
    for tile in finished(run):
        made = content((tmp_path / "tiles" / f"{tile.tile.id}.js").read_bytes())
        if not isinstance(tile.surface, LevelledSurface):
            assert "top" not in made
            assert made["surface"]
            continue
        assert made["surface"] is None
        at = np.meshgrid(tile.tile.grid.eastings, tile.tile.grid.northings)
        np.testing.assert_allclose(heights(made["top"], made["grid"]), view.height(*at), atol=1e-3)
        deck = np.isfinite(view.height(*at, 1))
        (top, height_source), (low, _) = tile.top_errors, tile.level_errors(0)
        np.testing.assert_array_equal(top[~deck], low[~deck])
        on_decks.append((top[deck], low[deck], height_source[deck]))
    top, low, height_source = (np.concatenate(values) for values in zip(*on_decks, strict=True))
    assert len(top) > 100
    assert top.mean() < 0.05
    assert low.mean() > 0.2
    assert (height_source == HeightSource.MEASURED).mean() > 0.5


@pytest.mark.slow
def test_dask_gives_the_same_products(run, tmp_path):
    other = made(tmp_path, DaskExecutor(2))
    for tile in run.catalog.tiles:
        for path in run.folder(tile.id).path.glob(f"{tile.id}_*"):
            assert (other.folder(tile.id).path / path.name).read_bytes() == path.read_bytes(), path.name


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (["ecsrc=paper"], "segment.levels needs ecsrc: planar, not paper"),
        (["fit=nurbs"], "segment.levels needs fit: smoothing_spline, not nurbs"),
        (["load.halo_m=20"], "segment.levels needs load.halo_m of 40 or more, not 20"),
        (["sample.method=uniform"], "segment.levels needs sample.method dynamic, not uniform"),
        (["sample.mask=filtered"], "segment.levels needs sample.mask raw, not filtered"),
        (["segment.outlines=false"], "levels need the outlines of roads"),
    ],
)
def test_stages_that_have_no_levels_are_refused(settings, message):
    with pytest.raises(ConfigError, match=message):
        load_config("production_vector", [*WITH_LEVELS, *settings])


def test_meshes_of_levels_meet_on_borders_and_abutments(run):
    tiles = finished(run)
    inner_x, inner_y = max(t.tile.grid.west for t in tiles), min(t.tile.grid.north for t in tiles)
    for number in (0, 1):
        meshes = [tile.mesh for tile in tiles if number in tile.mesh.numbers]
        whole = Union.of((mesh.at(number).vertices + mesh.origin, mesh.at(number).faces) for mesh in meshes)
        gaps = np.abs(whole.middles[whole.uses == 1] - (inner_x, inner_y)).min(axis=1, initial=np.inf)
        assert (gaps > 1e-6).all()
        assert whole.uses.max() == 2
    common = 0
    for tile in tiles:
        mesh, level = tile.mesh, tile.road.levels[0]
        ground, deck = (on_abutments(mesh.at(number), level) for number in (0, 1))
        if 1 in mesh.numbers:
            assert ground == deck
            common += len(deck)
    assert common > 10


def on_abutments(mesh, level):
    near = shapely.dwithin(level.abutments, shapely.points(mesh.vertices[:, :2] + mesh.origin[:2]), 0.02)
    return {tuple(vertex) for vertex in mesh.vertices[near].astype(np.float32).tolist()}


@pytest.mark.parametrize("level", [None, 0, 1, 2])
def test_mosaic_of_a_level_has_its_heights_alone(run, cells, level, tmp_path):
    x, y, *_ = cells
    view, words = flexroad.open_run(run.path), () if level is None else ("--level", level)
    said = call("export", run.path, "--format", "mosaic", "-o", tmp_path, *words).expected(0)
    assert ("no tile has a road of level 2" in said.err) == (level == 2)
    entry = json.loads((tmp_path / "export.json").read_bytes())["formats"]["mosaic"]
    assert entry.get("level") == level
    expected, deck = view.height(x, y, level), np.isfinite(view.height(x, y, 1))
    known = np.isfinite(expected)
    assert known.any() == (level != 2)

    def read(name, band=1):
        with rasterio.open(tmp_path / "mosaic" / f"{name}.tif") as file:
            return file.read(band), file.scales[0]

    np.testing.assert_allclose(read("height")[0], expected, atol=1e-3)
    (road, _), (up, scale) = read("road"), read("normal", 3)
    assert ((road == 255) == ~known).all()
    assert ((read("height_source")[0] == HeightSource.NONE) == ~known).all()
    assert ((up == -32768) == ~known).all()
    if level in (None, 1):
        assert (road[deck] == 1).mean() > 0.5
        assert up[deck].min() > 0.98 / scale


def test_smooth_formats_say_that_they_have_level_0(run, tmp_path):
    call("export", run.path, "--format", "step", "-o", tmp_path).expected(0)
    assert "the surface is the ground (level 0)" in (tmp_path / "export.json").read_text()


@pytest.fixture(scope="module")
def along(run, tmp_path_factory):
    """Exports along the roads of the run."""
    folder = tmp_path_factory.mktemp("along")
    call("export", run.path, "--format", "crg,xodr,lines", "-o", folder).expected(0)
    return folder


def truth(number, x, y):
    """Heights of the main road (1) or of the crossing road (0) at places on them."""
    world = Crossings(SEED)
    low, deck = world.height(0, x, y), world.height(1, x, y)
    return np.where(np.isfinite(deck) & (number == 1), deck, low), np.isfinite(deck)


def test_lines_have_the_heights_of_their_level(along):
    (file,) = (along / "lines").glob("*.gpkg")
    roads, segments = (geopandas.read_file(file, layer=layer) for layer in ("roads", "segments"))
    assert roads.level.tolist() == [1, 0]
    for road in roads.itertuples():
        x, y, z = shapely.get_coordinates(road.geometry, include_z=True).T
        expected, crossing = truth(road.level, x, y)
        assert np.abs(z - expected).max() < 0.05
        grade, true_grade = np.diff(z), np.diff(expected)
        assert np.abs(grade - true_grade).max() < 0.02
        own = segments[segments.road_id == road.id]
        middle = np.array([shapely.get_coordinates(line).mean(axis=0) for line in own.geometry])
        at = truth(road.level, *middle.T)[1]
        if road.level:
            assert ((own.level == 1) == at).mean() > 0.98
            assert own.error_m[at].max() < 0.1
            assert (own.height_source[at] == "measured").all()
        else:
            assert np.abs(own.grade_percent[at]).max() < 2
            assert (own.level == 0).all()
            assert (own.height_source[at] == "inferred").mean() > 0.5
        assert crossing.sum() > 5


def test_grids_across_a_abutment_are_on_the_deck(along):
    """Bilinear interpolation between the nodes of a grid would show a fall of 7 m."""
    report = pd.read_csv(along / "crg" / "roads.csv")
    assert len(report) == 2
    assert report.crg_max_mm.max() < 20
    assert report.profiles_mean_mm.max() < 30


def test_opendrive_has_two_heights_at_a_crossing_and_a_bridge(along):
    (file,) = (along / "xodr").glob("*.xodr")
    upper, lower = ElementTree.parse(file).getroot().findall("road")
    heights = []
    for number, road in ((1, upper), (0, lower)):
        s = np.arange(0.0, float(road.attrib["length"]), 0.5)
        x, y, heading = np.array([plan(road, at) for at in s]).T[..., None]
        # A profile is straight across a road, and its crown is some centimetres higher.
        v = np.linspace(-3.4, 3.4, 35)
        x, y = in_crs(file, "EPSG:25832", x - v * np.sin(heading), y + v * np.cos(heading))
        z = np.array([polynomial(road, "elevationProfile/elevation", at) for at in s])
        expected, deck = truth(number, x, y)
        assert np.abs(z - expected.mean(axis=1)).max() < 0.05
        deck = deck[:, 17]
        heights.append(z[deck].mean())
        if number:
            (bridge,) = road.findall("objects/bridge")
            start, length = numbers(bridge, "s", "length")
            assert start == pytest.approx(s[deck][0], abs=1)
            assert start + length == pytest.approx(s[deck][-1], abs=1)
        else:
            assert np.abs(np.diff(z)[deck[1:]] / 0.5).max() < 0.02
    assert heights[0] - heights[1] > 5
    assert lower.find("objects") is None


@pytest.fixture(scope="module")
def below(cells):
    """Places of the street below the deck of the main road, ``(n, 2)``."""
    x, y, *_ = cells
    lines = Crossings(SEED).roads((x.min(), y.min(), x.max(), y.max()))
    on = np.ones(x.shape, bool)
    for half_m, highway, level in ((CROSS_M, SIDE, 0), (MAIN_M, MAIN, 1)):
        roads = [line.points for line in lines if (line.highway, line.level) == (highway, level)]
        on &= shapely.dwithin(shapely.multilinestrings(roads), shapely.points(x, y), half_m)
    return np.column_stack([x[on], y[on]])


def from_glb(run, below, folder):
    """The Khronos validator and trimesh."""
    files, meshes = sorted(run.path.glob("tiles/*/*.glb")), []
    assert gltf_issues(files) == []
    for file in files:
        graph = (scene := trimesh.load(file)).graph
        for node in graph.nodes_geometry:
            matrix, name = graph[node]
            x, y, z = trimesh.transform_points(scene.geometry[name].vertices, matrix).T
            places = np.column_stack([x + run.origin[0], run.origin[1] - z, y])
            level = int(graph.transforms.parents[node] == "level 1")
            meshes.append((level, places, scene.geometry[name].faces))
    return on_meshes(meshes, below)


def from_cityjson(run, below, folder):
    """The program cjio, which joins the tiles."""
    call("export", run.path, "--format", "cityjson", "-o", folder).expected(0)
    (file,) = (folder / "cityjson").glob("*.jsonl")
    command = [validators.program("cjio"), "--suppress_msg", "stdin", "save", folder / "city.json"]
    subprocess.run(command, input=file.read_bytes(), check=True)
    city = json.loads((folder / "city.json").read_bytes())
    vertices = np.array(city["vertices"]) * city["transform"]["scale"] + city["transform"]["translate"]
    meshes = []
    for item in city["CityObjects"].values():
        (geometry,) = item["geometry"]
        meshes.append((int(item["type"] == "Bridge"), vertices, np.array(geometry["boundaries"])[:, 0]))
    return on_meshes(meshes, below)


def from_opendrive(run, below, folder):
    """The checker of ASAM, and netconvert, which has heights at places of its own in the middle of lanes."""
    call("export", run.path, "--format", "crg,xodr", "-o", folder).expected(0)
    (file,) = (folder / "xodr").glob("*.xodr")
    assert quality_issues(file) == []
    roads, places = by_sumo(file, folder)
    places[:, :2] = np.column_stack(in_crs(file, "EPSG:25832", *places[:, :2].T))
    near = shapely.dwithin(shapely.multipoints(below), shapely.points(places[:, :2]), 0.8)
    upper, lower = (int(road.attrib["id"]) for road in ElementTree.parse(file).getroot().findall("road"))
    return {0: places[near & (roads == lower)], 1: places[near & (roads == upper)]}


def from_python(run, below, folder):
    """No export: the heights of the run."""
    view = flexroad.open_run(run.path)
    return {level: np.column_stack([below, view.height(*below.T, level)]) for level in (0, 1)}


def on_meshes(meshes, places):
    """Return places with the heights of both levels by meshes: level, vertices and faces."""
    heights = np.full((2, len(places)), np.nan)
    for level, vertices, faces in meshes:
        here = on_mesh(vertices, faces, *places.T)
        heights[level] = np.where(np.isnan(here), heights[level], here)
    return {level: np.column_stack([places, heights[level]]) for level in (0, 1)}


@pytest.mark.parametrize("opened", [from_python, from_glb, from_cityjson, from_opendrive])
def test_every_export_of_a_crossing_has_both_heights_in_other_programs(opened, run, below, tmp_path):
    both = opened(run, below, tmp_path)
    for level, at_most in ((0, 0.06), (1, 0.02)):
        x, y, z = both[level].T
        off = np.abs(z - Crossings(SEED).height(level, x, y))
        assert len(z) >= 5
        assert off.mean() <= at_most


def test_roads_of_a_run_without_levels_have_no_column_of_them(run, tmp_path):
    catalog = Catalog.read(run.path.parent / "survey" / "catalog.parquet")
    plain = Run.create(tmp_path / "run", load_config("production_vector"), catalog)
    run_tiles(plain, SerialExecutor(), only=lambda tile: tile.id == catalog.tiles[0].id)
    call("export", plain.path, "--format", "xodr,lines", "-o", tmp_path / "out").expected(0)
    (file,) = (tmp_path / "out" / "lines").glob("*.gpkg")
    assert "level" not in geopandas.read_file(file, layer="roads")
    assert "level" not in geopandas.read_file(file, layer="segments")
    assert "<objects>" not in next((tmp_path / "out" / "xodr").glob("*.xodr")).read_text()


def test_one_surface_of_tiles_with_decks_is_refused_with_a_remedy(run):
    """Its spline would be that of level 0 alone, which is up to a metre wrong on approaches."""
    view = flexroad.open_run(run.path)
    levelled = {tile.id: isinstance(tile.surface, LevelledSurface) for tile in finished(run)}
    assert True in levelled.values()
    for tile in run.catalog.tiles:
        west, south, east, north = tile.grid.bounds
        inside = west + 1, south + 1, east - 1, north - 1
        if levelled[tile.id]:
            with pytest.raises(ConfigError, match=rf"tile {tile.id} has roads above roads.*level=0"):
                view.surface(inside)
        else:
            x, y = (west + east) / 2, (south + north) / 2
            assert view.surface(inside).height(x, y) == pytest.approx(float(view.height(x, y)), abs=1e-9)


def test_network_of_sumo_has_the_level_of_each_road(run, tmp_path):
    """By the heights of the roads that an edge meets."""
    roads = Crossings(SEED).roads(flexroad.open_run(run.path).tiles.total_bounds)
    edges = []
    for number, road in enumerate(roads):
        shape = " ".join(f"{x:.3f},{y:.3f}" for x, y in road.points)
        edges.append(f'<edge id="{number}"><lane id="{number}_0" index="0" shape="{shape}"/></edge>')
    place = '<location netOffset="0,0" projParameter="EPSG:25832"/>'
    source, out, report = (tmp_path / name for name in ("a.net.xml", "b.net.xml", "r.csv"))
    source.write_text("\n".join(["<net>", place, *edges, "</net>"]))
    call("lift", source, run.path, "-o", out, "--report", report).expected(0)
    levels = pd.read_csv(report, dtype=str, keep_default_na=False).set_index("id").levels
    ground, decks, below = RunSampler.open(run.path), 0, 0
    for number, road in enumerate(roads):
        shape = ElementTree.parse(out).getroot().find(f"edge[@id='{number}']/lane").get("shape")
        lifted = [[*map(float, each.split(",")), np.nan][:3] for each in shape.split()]
        x, y, z = np.array([point for point in lifted if np.isfinite(point[2])]).reshape(-1, 3).T
        found, _ = ground.heights(x, y, steps=False)
        low, deck = found.z if len(found.z) == 2 else (found.ground, np.full(len(x), np.nan))
        if road.level:
            decks += np.isfinite(deck).sum()
            assert "1" in levels[str(number)] or not len(deck)
        else:
            below += np.isfinite(deck).sum()
            deck = np.full(len(x), np.nan)
        # Beyond its abutments a road on a deck is on the ground.
        np.testing.assert_allclose(z, np.where(np.isfinite(deck), deck, low), atol=0.006)
    assert min(decks, below) > 0


# --- heights of roads on several levels ---------------------------------------------------------------

STEP_M = 0.5


@pytest.mark.parametrize(
    ("x", "y", "number", "own", "height", "step"),
    [
        (35, 24, 1, True, 107, 0),
        (35, 29, 1, True, 107, 0),  # beside the deck
        (35, 24, 0, True, 100, STEP_M),  # below it
        (20, 24, 0, True, 107, STEP_M),  # on the approach, level 0 has the deck's surface
        (20, 31, 1, False, 107, 0),  # beside the approach
        (20, 34, 1, False, 100, STEP_M),  # farther away the deck's surface does not count
        (46, 24, 1, False, 100, STEP_M),  # where no road goes on from the deck
        (44, 24, 1, False, 107, 0),  # the deck is longer than its centre line
        (35, 24, -1, True, np.nan, 0),  # a tunnel that was left out
        (50, 24, -1, False, 100, STEP_M),
        (50, 24, 2, True, 100, STEP_M),  # no deck of this level is known
    ],
)
def test_height_is_that_of_the_level(x, y, number, own, height, step):
    """A deck 7 m above the ground, from 25 to 45 m, with an approach from 9 m; and steps everywhere."""
    steps = np.full(GRID.shape, STEP_M, np.float32)
    surface = replace(made_surface(own=100.0, deck=107.0), steps=steps)
    at = np.array([WEST + x, WEST + 55.0]), np.array([SOUTH + y, SOUTH + 24.0])
    levels = PlaceLevels(np.array([number, 0], np.int8), np.array([own, True]))
    np.testing.assert_allclose(on_levels(surface, *at, levels), [height, 100], atol=1e-9)
    np.testing.assert_allclose(on_levels(surface, *at, levels, steps=True), [step, STEP_M], atol=1e-9)
