"""Tiles without roads are done: they have the terrain's surface, a flag, and no figures of roads."""

import json
from dataclasses import replace

import numpy as np
import pytest
import rasterio
import trimesh

from flexroad.catalog import Catalog
from flexroad.catalog.sources import rasters
from flexroad.pipeline.config.loading import compose, load_config
from flexroad.pipeline.execute import SerialExecutor
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.run.runner import run_tiles
from flexroad.pipeline.run.status import open_database, recorded, summary
from flexroad.pipeline.run.summary import summarise
from flexroad.pipeline.store.tables import read_metrics
from flexroad.pipeline.worker.tile import QUALITY
from flexroad.tasks.products import npz
from flexroad.tasks.quality.assess import NO_ROAD
from flexroad.tools.report.content import MAIN, STEPS, WITH_ROADS, WORST_ROADS, gather
from tests.builders import LIGHT
from tests.conftest import QUICK

BARE = (0, 3)
"""Numbers of the tiles without roads: opposite corners of the survey, each beside two tiles with roads."""
OF_ROADS = ("l2_road_m", "rmse_road_m", "nmad_road_m", "p95_road_m", "mad_road_deg", *QUALITY)
ENDS = (".glb", ".ply", "_height.tif", "_road.tif", "_surface.npz")
MASKS = ("road_mask", "reference_road")


def clear(tile, names=MASKS):
    """Take the road from the masks of a tile."""
    for name in names:
        (path,) = tile.paths(tile.layer(name).reaching(tile.grid.bounds))
        with rasterio.open(path, "r+") as raster:
            raster.write(np.zeros((1, *raster.shape), raster.dtypes[0]))


@pytest.fixture
def half(survey) -> Catalog:
    """A survey of four tiles, two of them without roads."""
    catalog = Catalog.read(survey)
    for number in BARE:
        clear(catalog.tiles[number])
    return catalog


def test_run_tiles_without_roads_are_done_flagged_and_cached(half, tmp_path, executor):
    run = Run.create(tmp_path / "run", compose(QUICK, "quick"), half)
    for cached in (0, 4):
        result = run_tiles(run, executor)
        assert (result.done, result.cached, result.without_roads, result.exit_code) == (4, cached, 2, 0)
    assert summary(run).without_roads == 2
    with open_database(run) as database:
        assert summarise(run.catalog, recorded(run, database, ""), "flexroad").without_roads == 2
    rows = read_metrics(run.path)
    bare = rows.tile_id.isin([half.tiles[number].id for number in BARE])
    assert set(rows.status) == {"done"}
    assert set(rows[bare]["flags"]) == {NO_ROAD}
    assert not rows[~bare]["flags"].str.contains(NO_ROAD).any()
    assert rows[bare][[*OF_ROADS]].drop(columns="bounded_weights").isna().all(axis=None)
    assert rows[bare][["l2_terrain_m", "mad_terrain_deg", "triangles"]].notna().all(axis=None)
    assert (rows[bare].road_fraction == 0).all()
    assert rows[~bare].l2_road_m.notna().all()
    content = gather(run)
    assert content.state.startswith("Tiles: 4 done (2 of them without roads")
    table = content.tables[MAIN][0].set_index("method")
    assert set(table.tiles) == {4}
    assert set(table[WITH_ROADS]) == {2}
    mine = rows[~bare & (rows.variant == "flexroad")]
    assert table["L2 road (m)"]["flexroad"] == pytest.approx(mine.l2_road_m.mean())
    assert len(content.tables[WORST_ROADS][0]) == 2


def test_products_of_tile_without_roads_open_and_follow_dtm(half, tmp_path):
    run = Run.create(tmp_path / "run", load_config("production"), half)
    assert run_tiles(run, SerialExecutor()).exit_code == 0
    tile = half.tiles[BARE[0]]
    product = {end: run.folder(tile.id).path / f"{tile.id}_flexroad{end}" for end in ENDS}
    assert set(trimesh.load(product[".glb"]).geometry) == {"terrain"}
    faces = len(trimesh.load(product[".ply"]).faces)
    assert faces == read_metrics(run.path).set_index("tile_id").triangles[tile.id]
    heights, road = (rasterio.open(product[f"_{kind}.tif"]).read(1) for kind in ("height", "road"))
    assert not road.any()
    (path,) = tile.paths(tile.layer("dtm").reaching(tile.grid.bounds))
    assert np.abs(heights - rasterio.open(path).read(1)).mean() < 0.05
    east, north = np.meshgrid(tile.grid.eastings, tile.grid.northings)
    surface = npz.decode(product["_surface.npz"].read_bytes())
    np.testing.assert_allclose(surface.height(east, north), heights, atol=1e-3)
    # The tile and its neighbours with roads are one surface.
    check, _ = gather(run).tables[STEPS]
    assert list(check.result) == ["one surface: all differences are exactly 0"]
    assert list(check.edges) == [4]


def test_command_counts_tiles_without_roads_apart(half, flexroad, tmp_path):
    config, out = tmp_path / "light.yaml", tmp_path / "run"
    config.write_text(json.dumps(LIGHT))
    where = half.tiles[0].root + "/catalog.parquet"
    words = ["run", "--config", config, "--catalog", where, "--out", out, "--executor", "serial"]
    alone = flexroad(*words, "--tile", half.tiles[BARE[0]].id).expected(0)
    assert "warning: no tile of this run has a road that the filter keeps; if there are roads" in alone.err
    said = flexroad(*words).expected(0)
    line = "4 tiles: 4 done (1 cached, 2 without roads), 0 failed, 0 pending"
    assert line in said.out
    assert "warning" not in said.err
    assert line in flexroad("status", out).out
    assert json.loads(flexroad("status", out, "--json").out)["without_roads"] == 2
    written = json.loads((out / "summary.json").read_text())
    assert (written["without_roads"], written["exit_code"]) == (2, 0)
    states = json.loads((out / "tiles.geojson").read_text())["features"]
    assert [state["properties"]["flags"] == NO_ROAD for state in states] == [
        number in BARE for number in range(4)
    ]
    flexroad("report", out, "--format", "md").expected(0)
    assert "| method | tiles | with roads |" in (out / "report.md").read_text()


@pytest.mark.parametrize("method", ["paper", "planar"])
def test_tile_whose_road_the_filter_drops_is_done_and_flagged(method, survey, tmp_path):
    filtered = {**LIGHT, "ecsrc": {"method": method, "min_area_m2": 1e6}}
    filtered["variants"] = {"flexroad": {}, "wo_dtm": {"fit": {"terrain": False}}, "plane": {"fit": "plane"}}
    catalog = Catalog.read(survey)
    run = Run.create(tmp_path / "run", compose(filtered, "light"), replace(catalog, tiles=catalog.tiles[:1]))
    result = run_tiles(run, SerialExecutor())
    assert (result.done, result.without_roads, result.exit_code) == (1, 1, 0)
    rows = read_metrics(run.path)
    assert rows["flags"].str.startswith(f"{NO_ROAD}, ").all()
    assert rows["flags"].str.contains("dropped").all()
    # The raw mask still classes the cells, so that no filter looks better for what it drops.
    assert rows.l2_road_m.notna().all()


def test_tiles_that_no_mask_reaches_are_done_and_meet_the_others(survey, tmp_path):
    folder = survey.parent
    for number in BARE:
        (folder / "road_mask" / f"{Catalog.read(survey).tiles[number].id}.tif").unlink()
    patterns = {name: f"{name}/*.tif" for name in ("dsm", "dtm", "road_mask")}
    tiles = rasters.index(folder, patterns, tile_size_m=60).tiles
    assert [tile.layer("road_mask") is None for tile in tiles] == [number in BARE for number in range(4)]
    run = Run.create(tmp_path / "run", load_config("production"), Catalog(tiles))
    result = run_tiles(run, SerialExecutor())
    assert (result.done, result.without_roads, result.exit_code) == (4, 2, 0)
    assert list(gather(run).tables[STEPS][0].result) == ["one surface: all differences are exactly 0"]


def test_tile_that_no_mask_reaches_is_done_with_a_note(survey, tmp_path):
    tile, other, *_ = Catalog.read(survey).tiles
    tile = replace(tile, layers=tuple(layer for layer in tile.layers if layer.name != "road_mask"))
    run = Run.create(tmp_path / "run", compose(LIGHT, "light"), Catalog((tile, other)))
    results = []
    assert run_tiles(run, SerialExecutor(), watch=results.append).without_roads == 1
    (result,) = (result for result in results if result.entry.tile_id == tile.id)
    assert result.notes == ("segment: no road mask reaches this tile, so it counts as a tile without roads",)
    # A road of the true mask that no segmenter found is measured.
    assert read_metrics(run.path).l2_road_m.notna().all()
