"""3D Tiles of a run: coarse meshes with their error, bounding volumes, photos, and what is written again."""

from dataclasses import replace

import numpy as np
import pytest
import rasterio
import trimesh
from matplotlib.tri import LinearTriInterpolator, Triangulation
from pyproj import Transformer

from flexroad.catalog import Catalog
from flexroad.pipeline.config.loading import compose
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.execute import SerialExecutor
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.run.runner import run_tiles
from flexroad.tasks.products import glb
from flexroad.tools.export import tile_outputs
from flexroad.tools.export import tileset as coarse
from flexroad.tools.export.driver import export
from flexroad.tools.export.georeference import Georeference
from flexroad.tools.export.relief import of_mesh
from flexroad.tools.export.source import select
from flexroad.tools.export.tiles3d import placed
from flexroad.tools.export.tileset import Aerial, Node, aerial_of, blocks, joined, of_classes
from flexroad.tools.synthetic.scenes import write_scenes
from tests.builders import LIGHT
from tests.read_exports import entries, from_earth, mesh_of
from tests.validators.gltf import gltf_issues

from .conftest import OPTIONS

DRAPED = replace(OPTIONS, drape=True)
WITHOUT = 3
"""Number of the tile without a photo."""


@pytest.fixture(scope="module")
def survey(tmp_path_factory):
    """Four tiles of 60 m, three of them with a photo."""
    tiles = Catalog.read(write_scenes(tmp_path_factory.mktemp("survey"), 4, 0, 60, dop=True)).tiles
    bare = tuple(layer for layer in tiles[WITHOUT].layers if layer.name != "dop")
    return Catalog((*tiles[:WITHOUT], replace(tiles[WITHOUT], layers=bare)))


def finished(catalog, folder, **options):
    run = Run.create(folder, compose({**LIGHT, **options}, "light"), catalog)
    assert run_tiles(run, SerialExecutor()).done == len(catalog.tiles)
    return run


@pytest.fixture(scope="module")
def city(survey, tmp_path_factory):
    """A run whose meshes have no photos."""
    return finished(survey, tmp_path_factory.mktemp("plain") / "city")


def exported(run, out, options=OPTIONS):
    manifest = export(select(run.path), out, ["3dtiles"], options, SerialExecutor())
    return manifest["formats"]["3dtiles"], out / "3dtiles"


@pytest.fixture(scope="module")
def plain(city, tmp_path_factory):
    return exported(city, tmp_path_factory.mktemp("out"))[1]


@pytest.fixture(scope="module")
def draped(city, tmp_path_factory):
    return exported(city, tmp_path_factory.mktemp("draped"), DRAPED)


def contains(outer, inner):
    difference = np.array(outer) - inner
    return (difference[[0, 1, 4]] <= 0).all() and (difference[[2, 3, 5]] >= 0).all()


def test_all_files_are_valid_by_the_khronos_validator(plain, draped):
    files = [*plain.rglob("*.glb"), *draped[1].rglob("*.glb")]
    assert len(files) == 10
    assert gltf_issues(files) == []


def test_bounding_volumes_contain_meshes_and_children(plain, draped):
    geographic = Transformer.from_crs("EPSG:4978", "EPSG:4979", always_xy=True)
    for folder in (plain, draped[1]):
        meshes = 0
        for entry, file, matrix, parent in entries(folder):
            region = entry["boundingVolume"]["region"]
            if parent:
                assert contains(parent["boundingVolume"]["region"], region)
                assert parent["geometricError"] >= entry["geometricError"]
            if file:
                longitude, latitude, height = geographic.transform(*mesh_of(file, matrix)[0].T)
                plan = np.radians([longitude, latitude])
                box = [*plan.min(axis=1), *plan.max(axis=1), height.min(), height.max()]
                assert contains(region, box)
                meshes += 1
        assert meshes == 5


def test_error_of_coarse_meshes_is_no_less_than_their_distance_from_the_tiles(city, plain):
    (found,) = [item for item in entries(plain) if item[0].get("refine") == "REPLACE"]
    entry, file, matrix, _ = found
    assert len(entry["children"]) == 4
    points, faces = mesh_of(file, matrix)
    x, y, z = from_earth(points).T
    corner = x.min(), y.min()
    (ax, ay), (bx, by) = np.moveaxis(np.diff(np.column_stack([x, y])[faces], axis=1), 0, -1)
    area = ax * by - ay * bx
    # Faces of the skirt are upright.
    coarse_height = LinearTriInterpolator(Triangulation(x - corner[0], y - corner[1], faces[area > 1]), z)
    worst = 0.0
    for tile in select(city.path).finished():
        mesh = tile.mesh
        fine = mesh.vertices + mesh.origin
        fine = np.concatenate([fine, fine[mesh.faces].mean(axis=1)])
        heights = coarse_height(fine[:, 0] - corner[0], fine[:, 1] - corner[1])
        assert (~heights.mask).mean() > 0.95
        worst = max(worst, np.abs(heights - fine[:, 2]).max())
    stated = entry["extras"]["vertical_error_m"]
    assert 0.3 * stated < worst <= stated + 0.002
    assert entry["geometricError"] >= stated
    # The skirt is deeper than the gap between two neighbours can be.
    skirt = trimesh.load_scene(file, process=False).to_geometry()
    assert z.min() <= z[np.unique(faces[area > 1])].min() - 2 * stated + 0.002
    assert len(skirt.vertices) == len(np.unique(skirt.faces))


def test_meshes_of_the_run_are_unchanged(survey, city, plain):
    for tile in survey.tiles:
        own = city.folder(tile.id).path / f"{tile.id}_flexroad.glb"
        assert (plain / "tiles" / f"{tile.id}.glb").read_bytes() == own.read_bytes()


def image_of(file):
    """The image of the first material, None if it has none."""
    material = next(iter(trimesh.load_scene(file, process=False).geometry.values())).visual.material
    return None if material.baseColorTexture is None else np.asarray(material.baseColorTexture, float)


def test_draped_tiles_have_the_photo_on_the_same_mesh(survey, plain, draped):
    written, folder = draped
    name = survey.tiles[WITHOUT].id
    assert written["notes"] == [f"1 tile without an orthophoto, in plain colours: {name}"]
    for number, tile in enumerate(survey.tiles):
        with_photo, without = (place / "tiles" / f"{tile.id}.glb" for place in (folder, plain))
        if number == WITHOUT:
            assert with_photo.read_bytes() == without.read_bytes()
            continue
        assert image_of(without) is None
        with rasterio.open(tile.paths(tile.layer("dop"))[0]) as photo:
            colour = photo.read().mean(axis=(1, 2))
        np.testing.assert_allclose(image_of(with_photo).mean(axis=(0, 1)), colour, atol=3)
        for points in zip(*(mesh_of(file, np.eye(4)) for file in (with_photo, without)), strict=True):
            np.testing.assert_array_equal(*points)


def test_coarse_mesh_has_the_colours_of_its_tiles(survey, plain, draped):
    (file,) = (plain / "coarse").iterdir()
    image = image_of(file)
    colours = np.array([glb.ROAD_SRGB, glb.TERRAIN_SRGB], float)
    nearest = np.abs(image[:, :, None] - colours).max(axis=3).min(axis=2)
    # Pixels on the edges of roads are between.
    assert np.median(nearest) < 4
    assert image.min() < 80 < 180 < image.max()
    (file,) = (draped[1] / "coarse").iterdir()
    image = image_of(file)
    # The south-west quarter is the first tile's.
    size = len(image) // 2
    with rasterio.open(survey.tiles[0].paths(survey.tiles[0].layer("dop"))[0]) as photo:
        colour = photo.read().mean(axis=(1, 2))
    np.testing.assert_allclose(image[size:, :size].mean(axis=(0, 1)), colour, atol=4)


def test_meshes_of_a_run_with_photos_are_unchanged_and_coarse_ones_have_them(survey, tmp_path, draped):
    run = finished(survey, tmp_path / "photos", export={"texture": True})
    for options in (OPTIONS, DRAPED):
        _, folder = exported(run, tmp_path / str(options.drape), options)
        for tile in survey.tiles:
            own = run.folder(tile.id).path / f"{tile.id}_flexroad.glb"
            assert (folder / "tiles" / f"{tile.id}.glb").read_bytes() == own.read_bytes()
        for file in (folder / "coarse").iterdir():
            assert file.read_bytes() == (draped[1] / "coarse" / file.name).read_bytes()


def test_photos_are_unlit_and_plain_colours_are_not(survey, plain, draped):
    files = sorted(draped[1].rglob("*.glb"))
    unlit = {file.name for file in files if b"KHR_materials_unlit" in file.read_bytes()}
    assert unlit == {file.name for file in files} - {f"{survey.tiles[WITHOUT].id}.glb"}
    assert not any(b"KHR_materials_unlit" in file.read_bytes() for file in plain.rglob("*.glb"))


def test_drape_without_any_photo_is_refused_before_anything_is_written(survey, tmp_path):
    bare = Catalog((survey.tiles[WITHOUT],))
    run = finished(bare, tmp_path / "bare")
    with pytest.raises(ConfigError, match="--drape needs an orthophoto .* leave out --drape"):
        export(select(run.path), tmp_path / "out", ["landxml", "3dtiles"], DRAPED, SerialExecutor())
    assert not (tmp_path / "out").exists()
    # One tile: its block has a coarse mesh all the same.
    _, folder = exported(run, tmp_path / "out")
    assert len(list((folder / "coarse").iterdir())) == 1


def test_changed_photo_is_written_again_with_what_it_is_part_of(city, survey, tmp_path, monkeypatch):
    written = []
    write = tile_outputs._write
    monkeypatch.setattr(tile_outputs, "_write", lambda job: written.append(job.tile.id) or write(job))
    exported(city, tmp_path, DRAPED)
    assert len(written) == 5
    path = survey.tiles[0].paths(survey.tiles[0].layer("dop"))[0]
    before = path.read_bytes()
    try:
        with rasterio.open(path, "r+") as photo:
            photo.write(255 - photo.read())
        written.clear()
        _, folder = exported(city, tmp_path, DRAPED)
    finally:
        path.write_bytes(before)
    assert written == [survey.tiles[0].id, coarse.PREFIX + next((folder / "coarse").iterdir()).stem]


def test_damaged_record_is_reported_with_the_remedy(city, tmp_path):
    _, folder = exported(city, tmp_path)
    record = next(path for path in (folder / ".coarse").iterdir() if not path.name.startswith(coarse.PREFIX))
    data = bytearray(record.read_bytes())
    data[len(data) // 2] ^= 255
    record.write_bytes(data)
    next((folder / "coarse").iterdir()).unlink()
    with pytest.raises(ConfigError, match=r"npz is damaged \(its checksum differs\); remove it and export"):
        exported(city, tmp_path)
    record.unlink()
    exported(city, tmp_path)


def far_and_near(folder, place):
    """Nodes of 13 synthetic tiles of 250 m: 8 in one km, 3 in the next, one 3 km north, one 40 km away."""
    rng = np.random.default_rng(4)
    corners = [(i * 250, j * 250) for i in range(4) for j in range(2)]
    corners += [(1000, 0), (1250, 0), (1000, 250), (500, 3250), (40_000, 0)]
    for number, corner in enumerate(corners):
        west, south = np.add(corner, (500_000, 5_600_000)).tolist()
        x, y = np.meshgrid(west + np.linspace(0, 250, 26), south + np.linspace(0, 250, 26))
        points = np.column_stack([x.ravel(), y.ravel(), 100 + rng.normal(0, 2, x.size)])
        a = np.arange(26 * 26).reshape(26, 26)
        quads = np.stack([a[:-1, :-1], a[:-1, 1:], a[1:, 1:], a[1:, :-1]], axis=-1).reshape(-1, 4)
        faces = np.concatenate([quads[:, :3], quads[:, [0, 2, 3]]]).astype(np.int32)
        ground = of_mesh(points, faces, coarse.TILE_M[0])
        image = Aerial(ground.bounds, np.full((125, 125, 3), 10.0 * number), np.ones((125, 125)))
        files, referred = coarse.record(f"t{number}", ground, image)
        for name, data in files.items():
            (folder / name).parent.mkdir(exist_ok=True)
            (folder / name).write_bytes(data)
        box = (west, south, west + 250, south + 250)
        where = placed(f"tiles/t{number}.glb", box, (90.0, 110.0), *place)
        cell = int(west // 1000), int(south // 1000)
        yield Node(coarse.row_of(f"t{number}", cell, where, 0.0, False) | referred)


def test_blocks_have_nested_levels_where_there_is_more_than_one_tile(tmp_path):
    place = Georeference("EPSG:25832", (500_000.0, 5_600_000.0, 0.0)), OPTIONS.datum
    near, far = blocks(list(far_and_near(tmp_path, place)), tmp_path, place, SerialExecutor())
    assert [near.row["uri"], far.row["uri"]] == [f"coarse/4000_{column}_1400.glb" for column in (125, 135)]
    assert [child.row["id"] for child in far.children] == ["t12"]
    lone, pair = sorted(near.children, key=lambda node: node.row["id"], reverse=True)
    # The tile 3 km in the north is alone up to the block.
    assert (lone.row["id"], lone.children) == ("t11", ())
    assert pair.row["uri"] == "coarse/2000_250_2800.glb"
    kilometres = {child.row["uri"]: len(child.children) for child in pair.children}
    assert kilometres == {"coarse/1000_500_5600.glb": 8, "coarse/1000_501_5600.glb": 3}
    errors = [node.row["error_m"] for node in (pair.children[0], pair, near)]
    assert errors == [16.0, 32.0, 64.0]
    exact = [node.row["vertical_m"] for node in (pair.children[0], pair, near)]
    assert 0 < exact[0] < exact[1] < exact[2]
    entry = near.entry()
    assert [child["geometricError"] for child in entry["children"]] == [32.0, 0.0]
    image = image_of(tmp_path / near.row["uri"])
    # 1500 m by 3500 m in pixels of 8 m.
    assert image.shape == (438, 188, 3)


@pytest.mark.parametrize("size", [(50, 50), (501, 333), (1600, 1600)])
def test_photo_becomes_pixels_at_its_place_in_little_memory(size):
    """Red is the distance from the western, green that from the northern edge."""
    width, height = size
    red, green = np.meshgrid((np.arange(width) + 0.5) / width * 200, (np.arange(height) + 0.5) / height * 200)
    jpeg = glb.jpeg(np.stack([red, green, 0 * red], axis=-1).round().astype(np.uint8), 95)
    pixels = aerial_of(glb.Texture(jpeg, (1000.0, 2000.0, 1100.0, 2100.0)), 2.0)
    rows, columns, _ = pixels.colour.shape
    assert max(rows, columns) <= 300
    image = joined([pixels], (1000.0, 2000.0, 1100.0, 2100.0), 2.0).colour
    expected = (np.arange(50) + 0.5) * 4
    # At its end the photo is repeated, as pixels are means of whole numbers of its own.
    np.testing.assert_allclose(image[:, 1:-1, 0].mean(axis=0), expected[1:-1], atol=1.5)
    np.testing.assert_allclose(image[1:-1, :, 1].mean(axis=1), expected[1:-1], atol=1.5)


def ramp(bounds, rows, columns):
    """An image whose red is its easting, and green its northing."""
    west, south, east, north = bounds
    x = west + (np.arange(columns) + 0.5) * (east - west) / columns
    y = north - (np.arange(rows) + 0.5) * (north - south) / rows
    red, green = np.meshgrid(x, y)
    return Aerial(bounds, np.stack([red, green, np.full_like(red, 9)], axis=-1), np.ones(red.shape))


def black_and_white(width, road, pixel):
    """An image of 40 m x 40 m of two triangles over its western part; road is black."""
    corners = np.array([[0, 0, 1], [width, 0, 1], [width, 40, 1], [0, 40, 1]], float)
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    return of_classes(corners, faces, np.array(road), ((0, 0, 0), (255, 255, 255)), (0, 0, 40, 40), pixel)


def test_of_classes_pixel_has_the_share_of_road():
    """Road is the triangle south-east of the diagonal."""
    image = black_and_white(40, [True, False], 4.0)
    assert image.colour.shape == (10, 10, 3)
    row, column = np.indices((10, 10))
    assert (image.colour[row + column > 9] == 0).all()
    assert (image.colour[row + column < 9] == 255).all()
    # Places on the diagonal count as road.
    np.testing.assert_allclose(image.colour[row + column == 9], 255 * 6 / 16)
    assert (image.share == 1).all()


def test_of_classes_pixel_beside_the_mesh_is_unknown():
    image = black_and_white(20, [True, True], 8.0)
    np.testing.assert_array_equal(image.share, np.tile([1, 1, 0.5, 0, 0], (5, 1)))
    assert (image.complete() == 0).all()


@pytest.mark.parametrize("pixel", [4.0, 7.0, 3.3])
def test_joined_pixels_are_means_over_their_area(pixel):
    bounds = (0.0, 0.0, 64.0, 32.0)
    parts = [ramp((0.0, 0.0, 32.0, 32.0), 64, 64), ramp((32.0, 0.0, 64.0, 32.0), 128, 128)]
    image = joined(parts, bounds, pixel)
    expected = ramp(bounds, *image.share.shape)
    np.testing.assert_allclose(image.colour, expected.colour, atol=0.02)
    np.testing.assert_allclose(image.share, 1)


def test_joined_weighs_colours_by_what_is_known_and_takes_the_nearest_elsewhere():
    image = joined([ramp((0.0, 0.0, 10.0, 10.0), 10, 10)], (0.0, 0.0, 20.0, 10.0), 1.0)
    np.testing.assert_array_equal(image.share, np.tile([1.0] * 10 + [0.0] * 10, (10, 1)))
    complete = image.complete()
    np.testing.assert_array_equal(complete[:, 10:], np.repeat(complete[:, 9:10], 10, axis=1))
    part = Aerial((0.0, 0.0, 2.0, 1.0), np.array([[[100.0] * 3, [200.0] * 3]]), np.array([[1.0, 0.25]]))
    image = joined([part], (0.0, 0.0, 2.0, 1.0), 2.0)
    np.testing.assert_allclose(image.colour, [[[120.0] * 3]])
    np.testing.assert_allclose(image.share, [[0.625]])
