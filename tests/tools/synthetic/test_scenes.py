"""Folders of scenes that `flexroad synthetic` writes, and the places of the benchmark."""

from collections import Counter
from pathlib import Path

import geopandas
import numpy as np
import pytest
import rasterio
from hypothesis import example, given, settings
from hypothesis import strategies as st

from flexroad.catalog import Catalog
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.execute import SerialExecutor
from flexroad.tasks.load import Options, load
from flexroad.tasks.roads.attributes import level_numbers
from flexroad.tasks.segment import vector
from flexroad.tools.prepare.from_mesh import POINTS, MeshOptions, prepare_mesh
from flexroad.tools.prepare.options import PrepareOptions
from flexroad.tools.synthetic import make_scene
from flexroad.tools.synthetic.crossings import Crossings, make_crossings
from flexroad.tools.synthetic.dsc3d import survey as survey_of_scenes
from flexroad.tools.synthetic.gerod import APART_M, PRESET, STRATA, survey
from flexroad.tools.synthetic.prepared import HEIGHTS
from flexroad.tools.synthetic.scenes import write_scenes


@pytest.fixture(scope="module")
def benchmark(tmp_path_factory):
    return write_scenes(tmp_path_factory.mktemp("gerod"), 3, seed=2, preset="gerod")


def test_write_scenes_preset_catalog_lists_its_tiles(benchmark):
    tiles = {tile.id: tile for tile in Catalog.read(benchmark).tiles}
    expected = survey(3, 2)
    assert sorted(tiles) == sorted(tile_id for tile_id, *_ in expected)
    for tile_id, grid, stratum, _ in expected:
        assert tiles[tile_id].grid == grid
        assert tiles[tile_id].stratum == stratum
        assert tiles[tile_id].dataset == "synthetic benchmark gerod, seed 2"


def test_write_scenes_preset_files_contain_its_scenes(benchmark):
    tile_id, grid, stratum, options = survey(3, 2)[-1]
    scene = make_scene(grid, 2, stratum, options)
    for name, layer in {**scene.layers, "reference": scene.extended_dtm}.items():
        with rasterio.open(benchmark.parent / name / f"{tile_id}.tif") as file:
            cells = layer.astype(file.dtypes[0])
            assert np.array_equal(file.read(1), cells, equal_nan=cells.dtype.kind == "f")
            assert np.isnan(cells).any() == (name == "dsm")


def test_write_scenes_preset_second_catalog_has_truth(benchmark):
    paper, true = (
        {tile.id: tile for tile in Catalog.read(path).tiles}
        for path in (benchmark, benchmark.with_name("catalog_true.parquet"))
    )
    tile_id, grid, stratum, options = survey(3, 2)[0]
    scene = make_scene(grid, 2, stratum, options)
    extended, truth = (load(tiles[tile_id], Options()) for tiles in (paper, true))
    assert np.array_equal(truth.reference, scene.reference.astype(np.float32))
    assert np.array_equal(truth.reference_road, scene.reference_road)
    assert np.array_equal(extended.dsm, truth.dsm, equal_nan=True)
    # The extended DTM is the DTM but for the decks of bridges.
    assert np.mean(extended.reference == extended.dtm) > 0.9
    assert {tile.dataset for tile in true.values()} == {tile.dataset for tile in paper.values()}


def test_write_scenes_roads_are_true_and_repeatable(benchmark, tmp_path):
    for tile in Catalog.read(benchmark).tiles:
        data = load(tile, Options())
        road = vector.segment(data, vector.Options()).mask
        both, either = (road & data.reference_road).sum(), (road | data.reference_road).sum()
        assert both / either > 0.95
    again = write_scenes(tmp_path, 3, seed=2, preset="gerod")
    roads = "roads.gpkg"
    assert (again.parent / roads).read_bytes() == (benchmark.parent / roads).read_bytes()


@pytest.mark.parametrize(
    ("tiles", "options", "message"),
    [
        (
            1,
            {"size_m": 60, "preset": "gerod"},
            "--tile-size 60: tiles of gerod have 250 m; leave --tile-size",
        ),
        (
            1,
            {"size_m": 60, "preset": "dsc3d"},
            "--tile-size 60: tiles of dsc3d have 150 m; leave --tile-size",
        ),
        (6, {"preset": "dsc3d"}, "--tiles 6: dsc3d has 5 scenes; leave --tiles out for all of them"),
        (1, {"dop": True, "decks": True}, "--decks --dop: scenes with decks have no photos and no preset"),
        (1, {"preset": "gerod", "decks": True}, "--decks --preset gerod: .*; leave --preset gerod out"),
    ],
)
def test_write_scenes_of_options_that_do_not_fit_raises(tmp_path, tiles, options, message):
    with pytest.raises(ConfigError, match=message):
        write_scenes(tmp_path, tiles, seed=0, **options)
    assert not list(tmp_path.iterdir())


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """Tiles of one scene of the stand-in, with the paper's reference and with the true one."""
    path = write_scenes(tmp_path_factory.mktemp("dsc3d"), 1, seed=4, preset="dsc3d")
    (circular,) = Catalog.read(path).tiles
    (true,) = Catalog.read(path.with_name("catalog_true.parquet")).tiles
    return circular, true


def read(tile, name):
    (path,) = tile.paths(tile.layer(name))
    with rasterio.open(path) as file:
        return file.read(1)


@pytest.mark.slow
def test_stand_in_catalogs_share_layers_of_prepare_mesh(scene):
    circular, true = scene
    assert circular.id == true.id == survey_of_scenes(1, 4)[0].site.name
    assert circular.grid == true.grid == survey_of_scenes(1, 4)[0].grid
    assert {layer.name for layer in circular.layers} == {*HEIGHTS, "road_mask", "reference_road", "dop"}
    prefix = "synthetic photogrammetry, stand-in for DSC3D, seed 4; "
    assert circular.dataset == prefix + "reference by ECSRC itself (circular)"
    assert true.dataset == prefix + "true reference"
    for name in ("dsm", "dtm", "dop", "road_mask"):
        assert circular.paths(circular.layer(name)) == true.paths(true.layer(name))


@pytest.mark.slow
def test_stand_in_references_are_circular_and_true(scene):
    circular, true = scene
    place = survey_of_scenes(1, 4)[0]
    made = make_scene(place.grid, 4, place.site.stratum, place.options)
    assert np.array_equal(read(true, "reference"), made.reference.astype(np.float32))
    assert np.array_equal(read(true, "reference_road") != 0, made.reference_road)
    assert np.array_equal(read(circular, "road_mask") != 0, made.road_mask)
    kept = read(circular, "reference_road") != 0
    assert kept.any()
    assert not (kept & ~made.road_mask).any()
    reference, dsm, dtm = (read(circular, name) for name in ("reference", "dsm", "dtm"))
    assert np.array_equal(reference[kept], dsm[kept])
    assert np.array_equal(reference[~kept], dtm[~kept], equal_nan=True)
    # The DTM is the bare ground, except for errors of the reconstruction and the ground filter.
    assert np.nanmedian(np.abs(dtm - made.reference)) < 0.3
    assert np.isfinite(dsm).mean() > 0.97


@pytest.mark.slow
def test_stand_in_mesh_prepared_again_gives_same_rasters(scene, tmp_path):
    circular, _ = scene
    mesh = Path(circular.root) / circular.id / "mesh.glb"
    options = PrepareOptions(), MeshOptions(dop=False), POINTS
    published = prepare_mesh(mesh, tmp_path / "out", *options, SerialExecutor(), lambda _: None)
    (tile,) = Catalog.read(published.catalog).tiles
    assert tile.grid == circular.grid
    for name in ("dsm", "dtm"):
        assert np.array_equal(read(tile, name), read(circular, name), equal_nan=True)


@pytest.fixture(scope="module")
def decks(tmp_path_factory):
    return write_scenes(tmp_path_factory.mktemp("decks"), 4, seed=1, size_m=60, decks=True)


def test_write_scenes_decks_have_rasters_and_truth_of_both_levels(decks):
    tiles = Catalog.read(decks).tiles
    assert len(tiles) == 4
    for tile in tiles:
        scene = make_crossings(tile.grid, 1)
        data = load(tile, Options())
        assert np.array_equal(data.dsm, scene.dsm.astype(np.float32))
        for level, heights in scene.levels.items():
            with rasterio.open(
                decks.parent / "known" / f"level{level}" / "reference" / f"{tile.id}.tif"
            ) as file:
                np.testing.assert_array_equal(file.read(1), heights.astype(np.float32))
    assert sum(1 in make_crossings(tile.grid, 1).levels for tile in tiles) > 1


def test_write_scenes_decks_name_the_levels_of_their_roads(decks):
    table = geopandas.read_file(decks.with_name("roads.gpkg"))
    lines = {line.points.tobytes(): line for line in Crossings(1).roads((499980, 5599980, 500100, 5600100))}
    assert sorted(table.level) == sorted(line.level for line in lines.values())
    assert set(table.level) >= {0, 1}
    for names in ((), ("level",)):
        numbers, notes = level_numbers(table.drop(columns=list(names)))
        assert numbers.tolist() == table.level.tolist()
        assert notes == ()


@settings(max_examples=30)
@given(st.integers(1, 300), st.integers(0, 5))
@example(240, 1)
def test_survey_any_size_has_shares_of_paper(tiles, seed):
    places = survey(tiles, seed)
    assert len({name for name, *_ in places}) == tiles
    counts = Counter(stratum for _, _, stratum, _ in places)
    for stratum, share in STRATA.items():
        assert abs(counts[stratum] - tiles * share / 240) < 1


def test_survey_smaller_is_subset_of_larger():
    whole = {tile_id: (grid, stratum, options) for tile_id, grid, stratum, options in survey(240, 3)}
    for tile_id, *rest in survey(24, 3):
        assert whole[tile_id] == tuple(rest)
    assert survey(24, 4)[0][3] != survey(24, 3)[0][3]


def test_survey_tiles_lie_on_absolute_grid_and_apart():
    places = survey(240)
    corners = np.array([(grid.west, grid.south) for _, grid, _, _ in places])
    assert not (corners % 250).any()
    assert [tile_id for tile_id, *_ in places] == [f"{w:.0f}_{s:.0f}" for w, s in corners]
    distance = np.hypot(*(corners[:, None] - corners[None]).transpose(2, 0, 1))
    assert distance[distance > 0].min() == APART_M


def test_survey_options_vary_around_those_of_stratum():
    for _, _, stratum, options in survey(240, 2):
        assert 0.8 * PRESET[stratum].block_m <= options.block_m <= 1.2 * PRESET[stratum].block_m
        assert options.mask_errors == PRESET[stratum].mask_errors
    turns = [options.turn_deg for *_, options in survey(240, 2)]
    assert np.histogram(turns, 3, (0, 90))[0].min() > 50


@pytest.mark.parametrize("stratum", STRATA)
def test_survey_scenes_have_plausible_road_share_and_height(stratum):
    tiles = [place for place in survey(60) if place[2] == stratum][:3]
    scenes = [make_scene(grid, 0, name, options) for _, grid, name, options in tiles]
    least, most = {"urban": (0.12, 0.35), "suburban": (0.08, 0.3), "rural": (0.03, 0.2)}[stratum]
    for scene in scenes:
        assert scene.stratum == stratum
        assert least < scene.reference_road.mean() < most
        assert 0.001 < np.isnan(scene.dsm).mean() < 0.15
    raised = np.mean([np.nanmean((s.dsm - s.reference)[~s.reference_road]) for s in scenes])
    assert {"urban": 1.2, "suburban": 0.8, "rural": 0.3}[stratum] < raised < 4
