"""Map tiles have the heights of the surface, and say so."""

import io
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image
from pmtiles.reader import MmapSource, Reader, all_tiles
from pyproj import Transformer

from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.execute import SerialExecutor
from flexroad.pipeline.export.driver import export
from flexroad.pipeline.export.formats import FORMATS
from flexroad.pipeline.export.source import Options, select

WORLD = 2 * np.pi * 6378137
SIZE = 512


@pytest.fixture(scope="module")
def archive(town, tmp_path_factory):
    out = tmp_path_factory.mktemp("tiles")
    # Three levels.
    export(select(town.path), out, ["pmtiles"], Options(resolution_m=0.15), SerialExecutor())
    with (out / "pmtiles" / f"{town.path.name}.pmtiles").open("rb") as file:
        yield MmapSource(file)


def heights_of(archive):
    """The heights of each map tile by the definition of Terrarium; NaN where the file says there are none."""
    none = Reader(archive).metadata()["no_height_m"]
    found = {}
    for tile, data in all_tiles(archive):
        red, green, blue = np.moveaxis(np.asarray(Image.open(io.BytesIO(data)), float), -1, 0)
        heights = red * 256 + green + blue / 256 - 32768
        found[tile] = np.where(heights == none, np.nan, heights)
    return found


def places(town, zoom, column, row):
    """Eastings and northings of the pixel centres, by the definition of Web Mercator's tiles."""
    parts = (np.arange(SIZE) + 0.5) / SIZE
    x = ((column + parts) / 2**zoom - 0.5) * WORLD
    y = (0.5 - (row + parts) / 2**zoom) * WORLD
    back = Transformer.from_crs("EPSG:3857", town.tiles[0].grid.crs, always_xy=True)
    return back.transform(*np.meshgrid(x, y))


@pytest.mark.slow
def test_pixels_of_the_finest_level_are_the_surface(town, archive):
    zoom = Reader(archive).header()["max_zoom"]
    compared = 0
    for tile, heights in heights_of(archive).items():
        if tile[0] == zoom:
            expected, _ = town.at(*places(town, *tile))
            np.testing.assert_array_equal(np.isnan(heights), np.isnan(expected))
            assert np.nanmax(np.abs(heights - expected)) <= FORMATS["pmtiles"].precision_m
            compared += np.isfinite(expected).sum()
    # Three tiles of 60 m with pixels of at most 0.15 m.
    assert compared > 3 * (60 / 0.15) ** 2


@pytest.mark.slow
def test_pixels_of_other_levels_are_means_of_known_ones(archive):
    found = heights_of(archive)
    header = Reader(archive).header()
    assert header["max_zoom"] - header["min_zoom"] == 2
    for (zoom, column, row), heights in found.items():
        if zoom == header["max_zoom"]:
            continue
        finer = np.full((2 * SIZE, 2 * SIZE), np.nan)
        for i, j in np.ndindex(2, 2):
            child = found.get((zoom + 1, 2 * column + i, 2 * row + j))
            if child is not None:
                finer[j * SIZE : (j + 1) * SIZE, i * SIZE : (i + 1) * SIZE] = child
        parts = finer.reshape(SIZE, 2, SIZE, 2).swapaxes(1, 2).reshape(-1, 4)
        known = np.isfinite(parts).any(axis=1)
        np.testing.assert_array_equal(np.isfinite(heights).ravel(), known)
        means = np.nanmean(parts[known], axis=1)
        # The means are of heights that are not yet rounded to 1/256 m.
        assert np.abs(heights.ravel()[known] - means).max() <= 1 / 256


@pytest.mark.slow
def test_file_says_what_it_has(town, archive):
    reader = Reader(archive)
    header, metadata = reader.header(), reader.metadata()
    assert (header["tile_type"].name, header["tile_compression"].name) == ("PNG", "NONE")
    assert header["clustered"]
    assert (metadata["encoding"], metadata["tileSize"]) == ("terrarium", SIZE)
    assert "not above the ellipsoid" in metadata["description"]
    assert metadata["crs_of_run"] == "EPSG:25832"
    heights = np.concatenate([values[np.isfinite(values)] for values in heights_of(archive).values()])
    assert metadata["no_height_m"] < heights.min()
    to_degrees = Transformer.from_crs("EPSG:25832", "EPSG:4326", always_xy=True)
    corners = np.array([tile.grid.bounds for tile in town.tiles[:3]])
    west, south = to_degrees.transform(*corners[:, :2].min(axis=0))
    assert header["min_lon_e7"] / 1e7 == pytest.approx(west, abs=1e-5)
    assert header["min_lat_e7"] / 1e7 == pytest.approx(south, abs=1e-5)


def test_zoom_follows_from_the_cells_of_the_run(town, tmp_path):
    export(select(town.path), tmp_path, ["pmtiles"], Options(), SerialExecutor())
    with next((tmp_path / "pmtiles").iterdir()).open("rb") as file:
        header = Reader(MmapSource(file)).header()
    latitude = np.radians(header["center_lat_e7"] / 1e7)
    pixel = WORLD / SIZE / 2 ** header["max_zoom"] * np.cos(latitude)
    assert 0.5 < pixel <= 1.005


def test_run_without_heights_leaves_no_file(town, tmp_path):
    source = select(town.path)
    far = replace(source, tiles=source.tiles[:1])
    far.__dict__["finished"] = lambda: iter(())
    with pytest.raises(ConfigError, match="no selected tile has a height"):
        export(far, tmp_path, ["pmtiles"], Options(), SerialExecutor())
    assert list((tmp_path / "pmtiles").iterdir()) == []
