"""A model trained on made tiles by the command line, and held against what is known of them."""

import json
from dataclasses import replace

import numpy as np
import pytest
import yaml
from scipy import ndimage

from flexroad.catalog import Catalog, Layer
from flexroad.pipeline.benchmark.scenes import write_scenes
from flexroad.pipeline.config.loading import load_config
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.run.record import Run, check_models
from flexroad.pipeline.training.spatial_split import inside, split
from flexroad.pipeline.training.train import LabelledTiles, Samples, TrainOptions, train
from flexroad.tasks import load
from flexroad.tasks.roads import rasterise
from flexroad.tasks.roads.mask_cleanup import NOTHING
from flexroad.tasks.segment.pixels import segment
from tests.pipeline.cli.test_main import flexroad

QUICK = ("--set", "rounds=15", "--set", "cells=2000")


@pytest.fixture(scope="module")
def land(tmp_path_factory):
    return write_scenes(tmp_path_factory.mktemp("land"), 4, seed=3, size_m=80, dop=True)


@pytest.fixture(scope="module")
def trained(land, tmp_path_factory):
    model = tmp_path_factory.mktemp("model") / "roads.skops"
    flexroad("train", land, "--method", "pixels", "--labels", "mask", "-o", model, "--gap-m", 20, *QUICK)
    return model, json.loads(model.with_name("roads.skops.json").read_text())


def spoilt(catalog, **layers):
    """A catalog with layers taken out, or files of another layer in their place."""

    def of(tile):
        kept = [layer for layer in tile.layers if layers.get(layer.name, "") is not None]
        return replace(
            tile,
            layers=tuple(
                replace(layer, files=tile.layer(layers[layer.name]).files) if layer.name in layers else layer
                for layer in kept
            ),
        )

    return Catalog(tuple(of(tile) for tile in catalog.tiles))


def test_the_report_tells_what_the_segmenter_does_on_the_judged_tiles(land, trained):
    model, told = trained
    right = wrong = missed = 0
    options = segment.Options(model=model, cleanup=NOTHING)
    for tile in Catalog.read(land).select(told["asked"]["judged by"]).tiles:
        data = load.load(tile, load.Options())
        found = segment.segment(data, options).mask
        right += (found & data.reference_road).sum()
        wrong += (found & ~data.reference_road).sum()
        missed += (~found & data.reference_road).sum()
    assert told["all"]["iou"] == pytest.approx(right / (right + wrong + missed))
    assert told["all"]["recall"] == pytest.approx(right / (right + missed))
    # Chance on these tiles would be their share of road, below a third.
    assert told["all"]["iou"] > 0.6
    assert told["off_label_edges"]["iou"] > told["all"]["iou"]
    assert told["all"]["edge_mean_m"] < 5
    assert {*told["asked"]["judged by"], *told["asked"]["learnt from"]} == {
        t.id for t in Catalog.read(land).tiles
    }
    # At most the rounds asked for: how many, strips of the training tiles decide.
    losses = [entry["train_loss"] for entry in told["history"]]
    assert 1 < len(losses) <= 15
    assert losses[-1] < losses[0]


def test_the_page_stands_alone_and_shows_tiles(trained):
    model, told = trained
    page = model.with_name("roads.skops.html").read_text()
    assert 'src="data:image/png' in page
    assert "http" not in page
    assert all(tile in page for tile in told["asked"]["judged by"])


def test_the_model_runs_by_one_line_of_the_configuration(land, trained, quick_config, tmp_path):
    model, _ = trained
    quick = yaml.safe_load(quick_config.read_text()) | {"segment": {"method": "pixels", "model": str(model)}}
    config = tmp_path / "segment.yaml"
    config.write_text(yaml.safe_dump(quick))
    words = ("--config", config, "--catalog", land, "--out", tmp_path / "run", "--executor", "serial")
    assert "4 done" in flexroad("run", *words)


def test_cells_to_learn_from_keep_off_edges_and_off_the_judged_tiles(land):
    ground = LabelledTiles(
        TrainOptions("pixels", "mask", ignore_m=2.0), load.Options(halo_m=10.0), rasterise.DEFAULTS
    )
    catalog = Catalog.read(land)
    pieces = [piece for tile in catalog.tiles for piece in ground.pieces(tile, [tile.grid.bounds])]
    sides = split(pieces, 0.3, 30.0, 0)
    for sample in Samples(ground, sides, "train"):
        grid = sample.data.grid
        assert sample.known.any()
        assert not (sample.known & ~inside(grid, sample.data.core.bounds)).any()
        away = np.maximum(
            ndimage.distance_transform_edt(sample.road), ndimage.distance_transform_edt(~sample.road)
        )
        assert away[sample.known].min() > 2.0


def test_a_single_tile_is_parted(land):
    catalog = Catalog.read(land)
    one = Catalog(catalog.tiles[:1])
    settings = {"rounds": 5, "cells": 1000}
    outcome = train(
        one, load_config("paper"), TrainOptions("pixels", "mask", gap_m=10, settings=settings), print
    )
    assert outcome.split.train[0].tile == outcome.split.validate[0].tile
    assert outcome.split.train[0].bounds[2] == outcome.split.validate[0].bounds[0]


def test_labels_may_be_vectors(land, tmp_path):
    import geopandas
    from shapely.geometry import box

    tile = Catalog.read(land).tiles[0]
    west, south, east, _ = tile.grid.bounds
    path = tmp_path / "roads.gpkg"
    geopandas.GeoDataFrame(geometry=[box(west, south + 20, east, south + 30)], crs=tile.grid.crs).to_file(
        path
    )
    bare = replace(tile, layers=tuple(layer for layer in tile.layers if layer.name != "roads"))
    drawn = replace(bare, layers=(*bare.layers, Layer("roads", (str(path),))))
    ground = LabelledTiles(TrainOptions("pixels", "vector"), load.Options(), rasterise.DEFAULTS)
    _, road = ground.labelled(drawn)
    assert road[-30:-20].all()
    assert road.sum() == 10 * tile.grid.width
    assert ground.labelled(bare) is None


def refused(catalog, match, **asked):
    with pytest.raises(ConfigError, match=match):
        train(
            catalog,
            load_config("paper"),
            TrainOptions(**{"method": "pixels", "labels": "mask"} | asked),
            print,
        )


def test_what_cannot_be_learnt_from_is_refused(land):
    catalog = Catalog.read(land)
    refused(spoilt(catalog, road_mask=None, reference_road=None), "--reference-road or --road-mask")
    refused(spoilt(catalog, roads=None), "--roads", labels="vector")
    refused(spoilt(catalog, dop=None), "orthophoto", method="dinov2")
    refused(spoilt(catalog, reference_road="dsm"), "are road")
    refused(catalog, "lower --gap-m", gap_m=1000)
    refused(catalog, "there are dinov2, pixels", method="magic")
    refused(catalog, "--set leafs.*leaves", settings={"leafs": 3})


def test_a_missing_model_stops_a_run_before_it_begins(land, tmp_path, quick_config):
    quick = yaml.safe_load(quick_config.read_text()) | {
        "segment": {"method": "pixels", "model": "gone.skops"}
    }
    config = tmp_path / "segment.yaml"
    config.write_text(yaml.safe_dump(quick))
    with pytest.raises(ConfigError, match=r"gone.skops does not exist; make it with `flexroad train CATALOG"):
        check_models(load_config(config))
    with pytest.raises(ConfigError, match="does not exist"):
        Run.create(tmp_path / "run", load_config(config), Catalog.read(land))
    assert not (tmp_path / "run").exists()


def test_help_tells_the_choices():
    said = flexroad("train", "--help")
    for word in ("--method", "--labels", "--validation", "--gap-m", "--ignore-m", "--set", "--seed"):
        assert word in said
