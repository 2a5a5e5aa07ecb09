"""OBJ with the orthophoto: each vertex takes the colour that the photo has at its place."""

import io
import json
from dataclasses import replace

import numpy as np
import pytest
import rasterio
import trimesh
from PIL import Image

from flexroad.catalog import Catalog
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.execute import SerialExecutor
from flexroad.pipeline.run.record import Run
from flexroad.tools.export.driver import export
from flexroad.tools.export.source import Options, select

from .conftest import contents


def drape(city, out):
    return export(select(city.path), out, ["obj"], Options(drape=True), SerialExecutor())["formats"]["obj"]


@pytest.fixture(scope="module")
def draped(made_city, tmp_path_factory):
    out = tmp_path_factory.mktemp("draped")
    assert drape(made_city, out)["notes"] == []
    return out / "obj"


def test_vertices_point_to_their_places_in_the_photo(made_city, draped):
    assert {path.name for path in draped.iterdir() if path.is_file()} == {
        f"{tile_id}.{end}" for tile_id in made_city.done for end in ("obj", "mtl", "jpg", "json", "prj")
    }
    for tile_id in made_city.done:
        with rasterio.open(made_city.survey / "dop" / f"{tile_id}.tif") as raster:
            bounds, pixels = raster.bounds, np.moveaxis(raster.read(), 0, -1)
        assert np.abs(np.asarray(Image.open(draped / f"{tile_id}.jpg"), float) - pixels).mean() < 6
        origin = json.loads((draped / f"{tile_id}.json").read_text())["origin"]
        assert (draped / f"{tile_id}.mtl").read_text().count(f"map_Kd {tile_id}.jpg\n") == 2
        scene = trimesh.load_scene(draped / f"{tile_id}.obj", process=False)
        assert {part.visual.material.name for part in scene.geometry.values()} == {"road", "terrain"}
        for part in scene.geometry.values():
            image = part.visual.material.image
            assert image.size == pixels.shape[1::-1]
            u, v = part.visual.uv.T
            east, north, _ = (part.vertices + origin).T
            column, row = u * image.width, (1 - v) * image.height
            pixel_m = (bounds.right - bounds.left) / image.width
            np.testing.assert_allclose(bounds.left + column * pixel_m, east, rtol=0, atol=0.01 * pixel_m)
            np.testing.assert_allclose(bounds.top - row * pixel_m, north, rtol=0, atol=0.01 * pixel_m)


def test_draped_and_plain_files_replace_each_other(made_city, draped, tmp_path):
    plain = Options()
    export(select(made_city.path), tmp_path / "plain", ["obj"], plain, SerialExecutor())
    drape(made_city, tmp_path / "both")
    assert contents(tmp_path / "both" / "obj") == contents(draped)
    export(select(made_city.path), tmp_path / "both", ["obj"], plain, SerialExecutor())
    assert contents(tmp_path / "both") == contents(tmp_path / "plain")
    drape(made_city, tmp_path / "both")
    assert contents(tmp_path / "both" / "obj") == contents(draped)


def test_tile_with_a_new_photo_is_written_again(own_city, tmp_path):
    first = own_city.done[0]
    drape(own_city, tmp_path)
    before = {path: path.stat().st_mtime_ns for path in (tmp_path / "obj").glob("*.obj")}
    file = own_city.survey / "dop" / f"{first}.tif"
    with rasterio.open(file, "r+") as raster:
        raster.write(np.full_like(raster.read(), 200))
    drape(own_city, tmp_path)
    after = {path: path.stat().st_mtime_ns for path in (tmp_path / "obj").glob("*.obj")}
    assert {path.stem for path in before if before[path] != after[path]} == {first}
    image = np.asarray(Image.open(io.BytesIO((tmp_path / "obj" / f"{first}.jpg").read_bytes())))
    assert np.abs(image.astype(int) - 200).max() <= 2


def test_tile_without_a_photo_is_plain_with_a_note(own_city, tmp_path):
    first, second = own_city.done
    # White is nodata of the photo: it shows nothing of this tile.
    with rasterio.open(own_city.survey / "dop" / f"{second}.tif", "r+") as raster:
        raster.nodata = 255
        raster.write(np.full_like(raster.read(), 255))
    assert drape(own_city, tmp_path)["notes"] == ["1 tile: no orthophoto, in plain colours"]
    assert (tmp_path / "obj" / f"{first}.jpg").exists()
    assert not (tmp_path / "obj" / f"{second}.jpg").exists()
    assert "map_Kd" not in (tmp_path / "obj" / f"{second}.mtl").read_text()
    assert "\nvt " not in (tmp_path / "obj" / f"{second}.obj").read_text()


def test_broken_photo_is_an_error_of_one_line(own_city, tmp_path, flexroad):
    file = own_city.survey / "dop" / f"{own_city.done[0]}.tif"
    file.write_bytes(file.read_bytes()[:100])
    said = flexroad("export", own_city.path, "--format", "obj", "--drape", "-o", tmp_path)
    assert said.code == 2
    (line,) = said.errors
    assert f"tile {own_city.done[0]}: " in line
    assert f"{own_city.done[0]}.tif" in line


def test_run_without_photos_is_refused(own_city, tmp_path):
    tiles = [
        replace(tile, layers=tuple(layer for layer in tile.layers if layer.name != "dop"))
        for tile in Run.open(own_city.path).catalog.tiles
    ]
    Catalog(tuple(tiles)).write(own_city.path / "catalog.parquet", movable=False)
    with pytest.raises(ConfigError, match="--drape needs an orthophoto"):
        drape(own_city, tmp_path)
    assert not list(tmp_path.glob("obj"))
