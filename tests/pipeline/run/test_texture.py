"""Notes of a tile, and meshes with the orthophoto."""

import io
import json
from collections import Counter
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
from flexroad.pipeline.store.products import TileProducts
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


def texture_of(run, tile, part="terrain"):
    return mesh_of(run, tile).geometry[part].visual.material.baseColorTexture


def photo_of(catalog, number):
    tile = catalog.tiles[number]
    return tile.paths(tile.layer("dop"))[0]


def finished(folder, config, catalog, done=None):
    """Run a catalog; return the run and its results."""
    run, results = Run.create(folder, config, catalog), []
    counts = run_tiles(run, SerialExecutor(), watch=results.append)
    assert counts.done == (len(catalog.tiles) if done is None else done)
    return run, results


def off_place(part):
    """Return the error of the photo's place at each vertex (m); x is to the east and z to the south."""
    return told_place(part.visual) - part.vertices[:, [0, 2]] * (1, -1)


def events(run):
    return [json.loads(line) for line in (run.path / "log.jsonl").read_text().splitlines()]


def test_run_photo_lies_where_the_mesh_does_and_changes_nothing_else(photographed, tmp_path):
    textured, _ = finished(tmp_path / "textured", TEXTURED, photographed)
    plain, _ = finished(tmp_path / "plain", PLAIN, photographed)
    for number, tile in enumerate(photographed.tiles):
        one, other = mesh_of(textured, tile), mesh_of(plain, tile)
        for name, part in one.geometry.items():
            np.testing.assert_array_equal(part.vertices, other.geometry[name].vertices)
            assert getattr(other.geometry[name].visual, "uv", None) is None
            if number == WITHOUT:
                assert part.visual.uv is None
                continue
            errors = off_place(part)
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
    run, _ = finished(tmp_path / "run", TEXTURED, Catalog((tile,)))
    for part in mesh_of(run, tile).geometry.values():
        assert np.abs(off_place(part).mean(axis=0)).max() < 0.3 * CELL


def test_run_changed_photo_exports_its_tile_again_from_the_store(photographed, tmp_path):
    tile = photographed.tiles[0]
    textured, _ = finished(tmp_path / "textured", TEXTURED, photographed)
    plain, _ = finished(tmp_path / "plain", PLAIN, photographed)
    assert run_tiles(textured, SerialExecutor()).cached == 4
    before = texture_of(textured, tile, "road")
    with rasterio.open(photo_of(photographed, 0), "r+") as file:
        file.write(255 - file.read())
    results = []
    assert run_tiles(textured, SerialExecutor(), watch=results.append).cached == 3
    (again,) = [result for result in results if result.status == "done"]
    assert again.tile_id == tile.id
    assert again.computed == {"export": 1}
    after = texture_of(textured, tile, "road")
    np.testing.assert_allclose(255 - np.asarray(after, float), np.asarray(before, float), atol=4)
    assert run_tiles(plain, SerialExecutor()).cached == 4


def test_run_photo_above_limit_is_averaged(photographed, tmp_path):
    small = compose({**LIGHT, "export": {"texture": True, "texture_px": 64}}, "light")
    run, _ = finished(tmp_path / "run", small, Catalog(photographed.tiles[:1]))
    assert max(texture_of(run, photographed.tiles[0]).size) == 64


def test_run_unreadable_photo_fails_only_its_tile_and_names_the_file(photographed, tmp_path):
    path = photo_of(photographed, 1)
    path.write_bytes(path.read_bytes()[:300])
    _, results = finished(tmp_path / "run", TEXTURED, photographed, done=3)
    (failure,) = [failure for result in results for failure in result.failures]
    assert (failure.tile_id, failure.stage, failure.file) == (photographed.tiles[1].id, "export", str(path))


def test_run_photo_on_part_of_a_tile_is_noted(photographed, tmp_path):
    with rasterio.open(photo_of(photographed, 0), "r+") as file:
        file.nodata = 0
        values = file.read()
        values[:, :, : file.width // 2] = 0
        file.write(values)
    run, _ = finished(tmp_path / "run", TEXTURED, Catalog(photographed.tiles[:1]))
    (note,) = [event["notes"] for event in events(run) if "notes" in event]
    assert note == ["dop: 50.0% of the texture has no orthophoto and takes its mean colour"]
    assert np.asarray(texture_of(run, photographed.tiles[0])).min() > 5


def test_dry_run_names_the_tiles_without_a_texture(photographed, survey, flexroad, tmp_path, quick_config):
    photographed.write(survey)
    command = ("run", "--catalog", survey, "--out", tmp_path / "run", "--config", quick_config, "--dry-run")
    lines = flexroad(*command, "--set", "export.texture=true").expected(0).out.splitlines()
    bare = photographed.tiles[WITHOUT].id
    assert f"warning: 1 of 4 tiles would have no texture: no dop, which export.texture needs: {bare}" in lines
    assert not [line for line in flexroad(*command).expected(0).out.splitlines() if "texture" in line]


# --- notes: of the sources, whichever results are computed and whichever are stored --------------

CLEANED = "dsm: 2 cells outside -500..9000 m taken as nodata"
"""The note of `load` on the survey."""
ROADLESS = "segment: the road mask has no road cell on this tile"
"""The begin of the note of `segment`."""


@pytest.fixture
def run(survey, tmp_path):
    """A finished run of one tile, with a note of each of two stages."""
    catalog = Catalog(Catalog.read(survey).tiles[:1])
    (tile,) = catalog.tiles
    for name, values in (("dsm", [[1e6, 1e6]]), ("road_mask", np.zeros(tile.grid.shape))):
        (path,) = tile.paths(tile.layer(name).reaching(tile.grid.bounds))
        with rasterio.open(path, "r+") as raster:
            array = raster.read(1)
            rows, columns = np.shape(values)
            array[:rows, :columns] = values
            raster.write(array, 1)
    made, _ = finished(tmp_path / "run", PLAIN, catalog)
    load, segment = notes(made)
    assert load == CLEANED
    assert segment.startswith(ROADLESS)
    return made


def notes(run) -> list[str]:
    item = run.folder(run.catalog.tiles[0].id).path / "item.json"
    return json.loads(item.read_text())["properties"]["flexroad:notes"]


def computed(run, force=()) -> Counter:
    results = []
    run_tiles(run, SerialExecutor(), force=frozenset(force), watch=results.append)
    (result,) = results
    assert list(result.notes) == notes(run)
    return Counter(result.computed)


@pytest.mark.parametrize(
    ("changes", "force", "stage"),
    [
        ({}, "export", "export"),
        ({"export": {"formats": ["ply"]}}, None, "export"),
        ({"ecsrc": {"theta_z_m": 0.1}}, None, "ecsrc"),
        ({"evaluate": {"nearest": True}}, None, "evaluate"),
    ],
    ids=["exported again", "another format", "another filter", "another evaluation"],
)
def test_notes_of_stored_results_are_kept(changes, force, stage, run):
    before = notes(run)
    again = Run.create(run.path, compose({**LIGHT, **changes}, "changed"), run.catalog)
    parts = computed(again, filter(None, [force]))
    assert stage in parts
    assert "segment" not in parts
    assert notes(again) == before


def test_notes_of_tile_that_failed_in_between_are_kept(run, monkeypatch):
    before = notes(run)

    def full(*_):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(TileProducts, "finish", full)
        assert run_tiles(run, SerialExecutor(), force=frozenset({"export"})).failed == 1
    assert computed(run) == {"export": 1}
    assert notes(run) == before


def test_notes_of_shared_store_are_those_of_the_other_run(run, tmp_path):
    other = Run.create(tmp_path / "other", run.config, run.catalog, run.store)
    assert computed(other) == {"export": 1}
    assert notes(other) == notes(run)


def test_notes_of_corrected_source_are_gone(run):
    (tile,) = run.catalog.tiles
    (path,) = tile.paths(tile.layer("dsm").reaching(tile.grid.bounds))
    with rasterio.open(path, "r+") as raster:
        heights = raster.read(1)
        heights[0, :2] = heights[0, 2]
        raster.write(heights, 1)
    assert computed(run)["load"] == 1
    assert len(notes(run)) == 1
    assert notes(run)[0].startswith(ROADLESS)
