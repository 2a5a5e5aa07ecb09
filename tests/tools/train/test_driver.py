"""`flexroad train` on synthetic tiles; its report is compared with their known truth."""

import json
import shutil
from dataclasses import replace
from datetime import UTC, datetime

import geopandas
import numpy as np
import pytest
import rasterio
import yaml
from hypothesis import given
from hypothesis import strategies as st
from scipy import ndimage
from shapely.geometry import box

from flexroad.catalog import Catalog, Grid, Layer, Tile
from flexroad.pipeline.config.loading import load_config
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.run.record import Run, check_models
from flexroad.tasks import load
from flexroad.tasks.roads import rasterise
from flexroad.tasks.segment.dinov2 import segment
from flexroad.tools.synthetic.scenes import write_scenes
from flexroad.tools.train.driver import (
    Block,
    LabelledTiles,
    TrainOptions,
    inside,
    samples,
    split,
    split_tile,
    train,
)
from tests.command_line import call
from tests.make_backbone import save_backbone


@pytest.fixture(scope="module")
def land(tmp_path_factory):
    return write_scenes(tmp_path_factory.mktemp("land"), 4, seed=3, size_m=80, dop=True)


@pytest.fixture(scope="module")
def settings(tmp_path_factory):
    """Options of a quick training on a backbone with random weights."""
    backbone = save_backbone(tmp_path_factory.mktemp("backbone") / "tiny", hidden_size=96)
    quick = {"layers": 3, "gsd_m": 0.2, "window_px": 112, "epochs": 40, "learning_rate": 0.03}
    return {"backbone": str(backbone), **quick}


def words(settings, **changes):
    return [word for name, value in {**settings, **changes}.items() for word in ("--set", f"{name}={value}")]


@pytest.fixture(scope="module")
def trained(land, settings, tmp_path_factory):
    model = tmp_path_factory.mktemp("model") / "roads.safetensors"
    options = ("--labels", "mask", "--gap-m", 20, *words(settings))
    said = call("train", land, *options, "-o", model).expected(0)
    return model, json.loads(model.with_name("roads.safetensors.json").read_text()), said


def with_layers(catalog, **layers):
    """The catalog with layers removed (None), or with the files of another layer instead (its name)."""

    def changed(tile):
        kept = [layer for layer in tile.layers if layers.get(layer.name, "") is not None]
        return replace(
            tile,
            layers=tuple(
                replace(layer, files=tile.layer(layers[layer.name]).files) if layer.name in layers else layer
                for layer in kept
            ),
        )

    return Catalog(tuple(changed(tile) for tile in catalog.tiles))


def segmented(quick_config, model):
    """A configuration that segments roads with a model."""
    segment = {"segment": {"method": "dinov2", "model": str(model)}}
    options = yaml.safe_load(quick_config.read_text()) | segment
    quick_config.write_text(yaml.safe_dump(options))
    return quick_config


def test_train_report_equals_segmenter_on_validation_tiles(land, trained):
    model, report, _ = trained
    right = wrong = missed = 0
    options = segment.Options(model=model, cleanup="none")
    for tile in Catalog.read(land).select(report["asked"]["judged by"]).tiles:
        data = load.load(tile, load.Options())
        mask = segment.segment(data, options).mask
        right += (mask & data.reference_road).sum()
        wrong += (mask & ~data.reference_road).sum()
        missed += (~mask & data.reference_road).sum()
    assert report["all"]["iou"] == pytest.approx(right / (right + wrong + missed))
    assert report["all"]["recall"] == pytest.approx(right / (right + missed))
    # A mask that is road everywhere would have their fraction of road as IoU, below a third.
    assert report["all"]["iou"] > 0.6
    assert report["off_label_edges"]["iou"] > report["all"]["iou"]
    assert report["all"]["edge_mean_m"] < 5
    assert {*report["asked"]["judged by"], *report["asked"]["learnt from"]} == {
        t.id for t in Catalog.read(land).tiles
    }
    # At most the requested epochs; the loss on the validation tiles sets the number.
    losses = [entry["train_loss"] for entry in report["history"]]
    assert 1 < len(losses) <= 40
    assert losses[-1] < losses[0]


def test_train_with_poor_result_says_so_and_does_not_recommend_it(land, settings, tmp_path):
    survey = shutil.copytree(land.parent, tmp_path / "land")
    blobs = np.random.default_rng(0)
    for path in (survey / "reference_road").glob("*.tif"):
        with rasterio.open(path, "r+") as file:
            # Labels that nothing in the rasters tells: squares of 8 m at random places.
            squares = np.kron(blobs.random((10, 10)) < 0.15, np.ones((8, 8)))
            file.write(squares.astype(file.dtypes[0]), 1)
    model = tmp_path / "poor.safetensors"
    options = ("--labels", "mask", "--gap-m", 20, *words(settings, epochs=1))
    said = call("train", survey / land.name, *options, "-o", model).expected(0)
    report = json.loads(model.with_name("poor.safetensors.json").read_text())
    iou = report["all"]["iou"]
    assert iou < 0.4
    assert f"warning: an IoU of {iou:.2f} is poor (below 0.5)" in said.err
    assert "next:" not in said.out
    assert "segment: {" not in said.out
    page = model.with_name("poor.safetensors.html").read_text()
    assert f"Warning: an IoU of {iou:.2f} is poor" in page
    assert len(report["history"]) == 1
    assert "Loss by epoch" not in page


def test_train_with_good_result_says_how_to_use_it_and_its_page_shows_tiles(trained):
    model, report, said = trained
    assert f"next: in a configuration, segment: {{method: dinov2, model: {model}}}" in said.out
    assert "warning" not in said.err
    page = model.with_name("roads.safetensors.html").read_text()
    assert "Loss by epoch" in page
    assert 'src="data:image/png' in page
    assert "http" not in page
    assert all(tile in page for tile in report["asked"]["judged by"])


def test_run_with_trained_model_completes(land, trained, quick_config, tmp_path):
    model, *_ = trained
    config = segmented(quick_config, model)
    options = ("--config", config, "--catalog", land, "--out", tmp_path / "run", "--executor", "serial")
    assert "4 done" in call("run", *options).expected(0).out


def test_training_samples_keep_off_edges_and_validation_tiles(land):
    tiles = LabelledTiles(TrainOptions("mask", ignore_m=2.0), load.Options(halo_m=10.0), rasterise.DEFAULTS)
    catalog = Catalog.read(land)
    blocks = [block for tile in catalog.tiles for block in tiles.blocks(tile, [tile.grid.bounds])]
    sides = split(blocks, 0.3, 30.0, 0)
    for sample in samples(tiles, sides.train, sides.training_cells):
        grid = sample.data.grid
        assert sample.labelled.any()
        assert not (sample.labelled & ~inside(grid, sample.data.core.bounds)).any()
        distance = np.maximum(
            ndimage.distance_transform_edt(sample.road), ndimage.distance_transform_edt(~sample.road)
        )
        assert distance[sample.labelled].min() > 2.0


def test_labelled_reads_vector_labels(land, tmp_path):
    tile = Catalog.read(land).tiles[0]
    west, south, east, _ = tile.grid.bounds
    path = tmp_path / "roads.gpkg"
    geopandas.GeoDataFrame(geometry=[box(west, south + 20, east, south + 30)], crs=tile.grid.crs).to_file(
        path
    )
    bare = replace(tile, layers=tuple(layer for layer in tile.layers if layer.name != "roads"))
    drawn = replace(bare, layers=(*bare.layers, Layer("roads", (str(path),))), allowed=None)
    tiles = LabelledTiles(TrainOptions("vector"), load.Options(), rasterise.DEFAULTS)
    _, road = tiles.labelled(drawn)
    assert road[-30:-20].all()
    assert road.sum() == 10 * tile.grid.width
    assert tiles.labelled(bare) is None


@pytest.mark.parametrize(
    ("layers", "options", "message"),
    [
        ({"road_mask": None, "reference_road": None}, {}, "--reference-road or --road-mask"),
        ({"roads": None}, {"labels": "vector"}, "--roads"),
        ({"dop": None}, {}, "orthophoto"),
        ({"reference_road": "dsm"}, {}, "are road"),
        ({}, {"gap_m": 1000}, "lower --gap-m"),
        ({}, {"settings": {"epoch": 3}}, "--set epoch:.*epochs"),
    ],
)
def test_train_unusable_labels_or_settings_raise(land, layers, options, message):
    catalog = with_layers(Catalog.read(land), **layers)
    with pytest.raises(ConfigError, match=message):
        train(catalog, load_config("paper"), TrainOptions(**{"labels": "mask"} | options), print)


def test_train_single_tile_is_split_in_two(land, settings):
    single = Catalog(Catalog.read(land).tiles[:1])
    options = TrainOptions("mask", gap_m=10, settings={**settings, "epochs": 2})
    sides = train(single, load_config("paper"), options, print).split
    assert sides.train[0].tile == sides.validate[0].tile
    assert sides.train[0].bounds[2] == sides.validate[0].bounds[0]


def test_run_missing_model_raises_before_start(land, tmp_path, quick_config):
    config = segmented(quick_config, "gone.safetensors")
    with pytest.raises(
        ConfigError, match=r"gone.safetensors does not exist; make it with `flexroad train CATALOG"
    ):
        check_models(load_config(config))
    with pytest.raises(ConfigError, match="does not exist"):
        Run.create(tmp_path / "run", load_config(config), Catalog.read(land))
    assert not (tmp_path / "run").exists()


def make_block(col, row, road=10, ground=10, size=100):
    grid = Grid("EPSG:25832", 500000.0 + col * size, 5600000.0 + row * size, 1.0, size, size)
    tile = Tile(f"{col}_{row}", grid, (), "", datetime(2025, 1, 1, tzinfo=UTC))
    return Block(tile, grid.bounds, road, ground)


places = st.lists(st.tuples(st.integers(0, 6), st.integers(0, 6)), min_size=2, max_size=25, unique=True)


@given(places, st.floats(0.05, 0.9), st.integers(0, 9))
def test_split_sides_are_separated_by_straight_line(places, share, seed):
    sides = split([make_block(*place) for place in places], share, 0.0, seed)
    assert len(sides.train) + len(sides.validate) == len(places)
    assert len(sides.validate) == min(max(1, round(share * len(places))), len(places) - 1)
    corners = [np.array([block.bounds[0], block.bounds[1]]) for block in (*sides.train, *sides.validate)]
    side = np.array([0] * len(sides.train) + [1] * len(sides.validate))
    angles = 2 * np.pi * np.arange(8) / 8
    along = np.array(corners) @ np.array([np.sin(angles), np.cos(angles)])
    assert any(along[side == 0, i].max() <= along[side == 1, i].min() + 1e-6 for i in range(8))


@given(places, st.sampled_from([0.0, 30.0, 150.0]), st.integers(0, 9))
def test_training_cells_keep_gap_to_validation_side(places, gap, seed):
    sides = split([make_block(*place) for place in places], 0.3, gap, seed)
    validation_bounds = [block.bounds for block in sides.validate]
    for block in sides.train:
        grid = block.tile.grid
        cells = sides.training_cells(grid, block.bounds)
        rows, cols = np.nonzero(cells)
        for west, south, east, north in validation_bounds:
            x, y = grid.eastings[cols], grid.northings[rows]
            distance = np.maximum(np.maximum(west - x, x - east), np.maximum(south - y, y - north))
            assert not cells.any() or distance.min() >= gap


def test_split_both_sides_have_labels_of_both_classes():
    with_road = {(0, 0), (3, 0)}
    blocks = [make_block(col, 0, road=10 if (col, 0) in with_road else 0) for col in range(4)]
    for seed in range(6):
        sides = split(blocks, 0.25, 0.0, seed)
        assert sides.validate[0].tile.id in {"0_0", "3_0"}
    with pytest.raises(ConfigError, match="1 of them with road; label more tiles"):
        split([make_block(col, 0, road=10 * (col == 2)) for col in range(4)], 0.25, 0.0, 0)


def test_split_tile_divides_along_longer_side():
    grid = Grid("EPSG:25832", 0.0, 100.0, 1.0, 50, 100)
    train, validate = split_tile(grid.bounds, 0.3)
    assert (inside(grid, train).sum(), inside(grid, validate).sum()) == (3500, 1500)
    assert not (inside(grid, train) & inside(grid, validate)).any()
