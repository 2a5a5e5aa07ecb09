"""Meshes with the orthophoto: its place on them, the cost of a changed photo, tiles without one."""

import io
import json
from dataclasses import replace

import numpy as np
import pytest
import rasterio
import trimesh
from rasterio.enums import Resampling
from rasterio.vrt import WarpedVRT
from scipy.ndimage import map_coordinates

from flexroad.catalog import Catalog, Layer
from flexroad.pipeline.config.loading import compose
from flexroad.pipeline.execute import SerialExecutor
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.run.runner import run_tiles
from flexroad.pipeline.worker.exports import NO_PHOTO
from tests.builders import LIGHT

CELL = 0.5
TEXTURED = compose({**LIGHT, "export": {"texture": True}}, "light")
PLAIN = compose(LIGHT, "light")
WITHOUT = 3
"""Number of the tile without a photo."""


def place_photo(tile):
    """Write a photo of the tile and 5 m around it: red is easting, green is northing, in 0.3 m."""
    west, _, _, north = tile.grid.bounds
    n = round((tile.grid.width * tile.grid.cell + 10) / CELL)
    ramp = np.broadcast_to((np.arange(n) + 0.5) * CELL / 0.3, (n, n))
    path = tile.paths(tile.layers[0])[0].parent / f"{tile.id}_dop.tif"
    values = np.stack([ramp, ramp.T[::-1], np.full((n, n), 90.0)]).round().astype(np.uint8)
    profile = {"driver": "GTiff", "dtype": "uint8", "count": 3, "crs": tile.grid.crs, "width": n, "height": n}
    transform = rasterio.transform.from_origin(west - 5, north + 5, CELL, CELL)
    with rasterio.open(path, "w", transform=transform, **profile) as file:
        file.write(values)
    return replace(tile, layers=(*tile.layers, Layer("dop", (str(path),), extents=(tile.grid.bounds,))))


@pytest.fixture
def photographed(survey) -> Catalog:
    """The survey with a photo on all tiles but one."""
    tiles = Catalog.read(survey).tiles
    return Catalog(tuple(t if n == WITHOUT else place_photo(t) for n, t in enumerate(tiles)))


def mesh_of(run, tile):
    path = run.folder(tile.id).path / f"{tile.id}_flexroad.glb"
    return trimesh.load_scene(io.BytesIO(path.read_bytes()), file_type="glb", process=False)


def told_place(visual):
    """Return the easting and northing from the tile's corner that the photo tells each vertex, ``(V, 2)``."""
    # trimesh's v is upward.
    texels = np.asarray(visual.material.baseColorTexture, float)[::-1]
    place = (visual.uv * texels.shape[1::-1] - 0.5)[:, ::-1].T
    return np.stack([map_coordinates(texels[..., k], place, order=1) for k in (0, 1)], axis=1) * 0.3 - 5


def photo_of(catalog, number):
    tile = catalog.tiles[number]
    return tile.paths(tile.layer("dop"))[0]


def test_run_photo_lies_where_the_mesh_does_and_changes_nothing_else(photographed, tmp_path):
    textured = Run.create(tmp_path / "textured", TEXTURED, photographed)
    plain = Run.create(tmp_path / "plain", PLAIN, photographed)
    assert [run_tiles(run, SerialExecutor()).done for run in (textured, plain)] == [4, 4]
    for number, tile in enumerate(photographed.tiles):
        one, other = mesh_of(textured, tile), mesh_of(plain, tile)
        for name, part in one.geometry.items():
            np.testing.assert_array_equal(part.vertices, other.geometry[name].vertices)
            assert getattr(other.geometry[name].visual, "uv", None) is None
            if number == WITHOUT:
                assert part.visual.uv is None
                continue
            # x is east of the tile's corner and z south of it.
            errors = told_place(part.visual) - part.vertices[:, [0, 2]] * (1, -1)
            # JPEG changes colours by up to 4, which are 1.2 m; half a pixel would show in the mean.
            assert np.abs(errors).max() < 1.5
            assert np.abs(errors.mean(axis=0)).max() < 0.2 * CELL
    noted = {event["tile"]: event["notes"] for event in events(textured) if "notes" in event}
    bare = photographed.tiles[WITHOUT].id
    assert noted == {bare: [NO_PHOTO]}
    item = json.loads((textured.folder(bare).path / "item.json").read_text())
    assert item["properties"]["flexroad:notes"] == [NO_PHOTO]
    assert not any("notes" in event for event in events(plain))


def test_run_photo_in_another_crs_is_warped_if_its_layer_allows_it(photographed, tmp_path):
    tile, path = photographed.tiles[0], photo_of(photographed, 0)
    with (
        rasterio.open(path) as file,
        WarpedVRT(file, crs="EPSG:25833", resampling=Resampling.bilinear) as vrt,
    ):
        profile = {"driver": "GTiff", "dtype": "uint8", "count": 3, "crs": vrt.crs, "nodata": 0}
        profile |= {"width": vrt.width, "height": vrt.height, "transform": vrt.transform}
        values = vrt.read()
    with rasterio.open(path, "w", **profile) as file:
        file.write(values)
    photo = replace(tile.layer("dop"), reproject=True)
    tile = replace(tile, layers=(*tile.layers[:-1], photo))
    run = Run.create(tmp_path / "run", TEXTURED, Catalog((tile,)))
    assert run_tiles(run, SerialExecutor()).done == 1
    for part in mesh_of(run, tile).geometry.values():
        errors = told_place(part.visual) - part.vertices[:, [0, 2]] * (1, -1)
        assert np.abs(errors.mean(axis=0)).max() < 0.3 * CELL


def events(run):
    return [json.loads(line) for line in (run.path / "log.jsonl").read_text().splitlines()]


def test_run_changed_photo_exports_its_tile_again_from_the_store(photographed, tmp_path):
    textured = Run.create(tmp_path / "textured", TEXTURED, photographed)
    plain = Run.create(tmp_path / "plain", PLAIN, photographed)
    for run in (textured, plain):
        assert run_tiles(run, SerialExecutor()).done == 4
        assert run_tiles(run, SerialExecutor()).cached == 4
    before = mesh_of(textured, photographed.tiles[0]).geometry["road"].visual.material.baseColorTexture
    with rasterio.open(photo_of(photographed, 0), "r+") as file:
        file.write(255 - file.read())
    results = []
    assert run_tiles(textured, SerialExecutor(), watch=results.append).cached == 3
    (again,) = [result for result in results if result.status == "done"]
    assert again.tile_id == photographed.tiles[0].id
    assert again.computed == {"export": 1}
    after = mesh_of(textured, photographed.tiles[0]).geometry["road"].visual.material.baseColorTexture
    np.testing.assert_allclose(255 - np.asarray(after, float), np.asarray(before, float), atol=4)
    assert run_tiles(plain, SerialExecutor()).cached == 4


def test_run_photo_above_limit_is_averaged(photographed, tmp_path):
    small = compose({**LIGHT, "export": {"texture": True, "texture_px": 64}}, "light")
    run = Run.create(tmp_path / "run", small, Catalog(photographed.tiles[:1]))
    assert run_tiles(run, SerialExecutor()).done == 1
    image = mesh_of(run, photographed.tiles[0]).geometry["terrain"].visual.material.baseColorTexture
    assert max(image.size) == 64


def test_run_unreadable_photo_fails_only_its_tile_and_names_the_file(photographed, tmp_path):
    path = photo_of(photographed, 1)
    path.write_bytes(path.read_bytes()[:300])
    run = Run.create(tmp_path / "run", TEXTURED, photographed)
    results = []
    assert run_tiles(run, SerialExecutor(), watch=results.append).done == 3
    (failure,) = [failure for result in results for failure in result.failures]
    assert (failure.tile_id, failure.stage, failure.file) == (photographed.tiles[1].id, "export", str(path))


def test_run_photo_on_part_of_a_tile_is_noted(photographed, tmp_path):
    tile = photographed.tiles[0]
    with rasterio.open(photo_of(photographed, 0), "r+") as file:
        file.nodata = 0
        values = file.read()
        values[:, :, : file.width // 2] = 0
        file.write(values)
    run = Run.create(tmp_path / "run", TEXTURED, Catalog((tile,)))
    assert run_tiles(run, SerialExecutor()).done == 1
    (note,) = [event["notes"] for event in events(run) if "notes" in event]
    assert note == ["dop: 50.0% of the texture has no orthophoto and takes its mean colour"]
    image = mesh_of(run, tile).geometry["terrain"].visual.material.baseColorTexture
    assert np.asarray(image).min() > 5


def test_dry_run_names_the_tiles_without_a_texture(photographed, survey, flexroad, tmp_path, quick_config):
    photographed.write(survey)
    command = ("run", "--catalog", survey, "--out", tmp_path / "run", "--config", quick_config, "--dry-run")
    lines = flexroad(*command, "--set", "export.texture=true").expected(0).out.splitlines()
    bare = photographed.tiles[WITHOUT].id
    assert f"warning: 1 of 4 tiles would have no texture: no dop, which export.texture needs: {bare}" in lines
    assert not [line for line in flexroad(*command).expected(0).out.splitlines() if "texture" in line]
