"""A run that lacks a layer on every tile is refused before the first tile."""

from dataclasses import replace

import pytest

from flexroad.catalog import Catalog, Layer
from flexroad.pipeline.config.loading import compose, load_config
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.graph.layers import ADD_ROADS, check_layers, fitting_config, without_photo


@pytest.fixture
def tiles(made_survey):
    return Catalog.read(made_survey / "catalog.parquet").tiles


def without(tile, *names):
    return replace(tile, layers=tuple(layer for layer in tile.layers if layer.name not in names))


@pytest.mark.parametrize(
    ("config", "missing", "remedy"),
    [
        ("paper", ("road_mask",), "it has vector roads: use --config production_vector, or segment: vector"),
        ("production_vector", ("roads",), "it has a road mask: use --config production, or segment: mask"),
        ("production", ("road_mask", "roads"), ADD_ROADS),
        ("production", ("dtm",), "add its files to the catalog (`flexroad catalog rasters --dtm`)"),
    ],
)
def test_check_layers_no_tile_has_layer_names_remedy(config, missing, remedy, tiles):
    lacking = Catalog(tuple(without(tile, *missing) for tile in tiles))
    with pytest.raises(ConfigError) as refused:
        check_layers(load_config(config), lacking)
    (line,) = str(refused.value).splitlines()
    assert f"(layer {missing[0]}), which " in line
    assert line.endswith(remedy)
    # The other tiles can be processed, so one tile that has the layer is enough.
    check_layers(load_config(config), Catalog((*lacking.tiles[1:], tiles[0])))


def test_check_layers_looks_at_every_variant(tiles):
    config = compose({"variants": {"flexroad": {}, "other": {"segment": "vector"}}}, "mine")
    with pytest.raises(ConfigError, match="which segment: vector needs"):
        check_layers(config, Catalog(tuple(without(tile, "roads") for tile in tiles)))


def test_check_layers_texture_needs_one_tile_with_a_photo(tiles):
    config = load_config("production", ["export.texture=true"])
    with pytest.raises(ConfigError) as refused:
        check_layers(config, Catalog(tiles))
    (line,) = str(refused.value).splitlines()
    assert "no tile of the catalog has an orthophoto (layer dop), which export.texture needs" in line
    assert line.endswith("(`flexroad catalog rasters --dop`), or set export.texture to false")
    photographed = replace(tiles[0], layers=(*tiles[0].layers, Layer("dop", ("dop.tif",))))
    check_layers(config, Catalog((photographed, *tiles[1:])))
    assert without_photo([photographed, *tiles[1:]], config) == [tile.id for tile in tiles[1:]]
    assert without_photo(tiles, load_config("production")) == []


def test_fitting_config_takes_the_layer_of_most_tiles(tiles):
    assert fitting_config(Catalog(tiles)) == "production"
    few_masks = (tiles[0], *(without(tile, "road_mask") for tile in tiles[1:]))
    assert fitting_config(Catalog(few_masks)) == "production_vector"


@pytest.mark.parametrize("words", [(), ("--dry-run",)])
def test_run_without_any_road_source_exits_before_the_first_tile(words, survey, flexroad, tmp_path):
    tiles = Catalog.read(survey).tiles
    Catalog(tuple(without(tile, "road_mask", "roads") for tile in tiles)).write(survey)
    command = ("run", "--catalog", survey, "--out", tmp_path / "run", "--executor", "serial")
    (line,) = flexroad(*command, *words).expected(2).errors
    assert line.startswith("error: production: no tile of the catalog has a road mask")
    assert not (tmp_path / "run" / "tiles").exists()
