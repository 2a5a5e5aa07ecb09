"""``flexroad init`` tells downloads by name and content, and its commands run as they are printed."""

import shlex

import numpy as np
import pytest
from rasterio.warp import transform
from shapely import LineString, box

from flexroad.catalog import Catalog
from flexroad.pipeline.run.record import RECORD
from flexroad.tools.check import downloads as downloads_module
from tests.make_rasters import write, write_xyz
from tests.make_roads import write as write_roads

WEST, NORTH = 400_020.0, 5_700_060.0


@pytest.fixture
def downloads(tmp_path, monkeypatch):
    """A folder of heights in two subfolders, vector roads and an orthophoto."""
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "my downloads"
    ground = np.full((60, 60), 100, np.float32)
    for name in ("DOM/a_1.tif", "DGM/a_1.tif"):
        write(folder / name, ground, WEST, NORTH)
        write(folder / name.replace("1", "2"), ground, WEST + 60, NORTH)
    write_roads(folder / "roads.gpkg", [box(WEST, NORTH - 35, WEST + 120, NORTH - 25)])
    return folder


def test_init_commands_run_as_printed(downloads, flexroad, tmp_path):
    said = flexroad("init", downloads, "--write", "own.yaml").expected(0).out
    assert "surface models (DSM): 2" in said
    assert "  DOM/a_1.tif: 1 band float32, 60 x 60, values 100 to 100, EPSG:25832" in said
    assert "question:" not in said
    commands = [line for line in said.splitlines() if line.startswith("flexroad ")]
    catalog, check, run = (shlex.split(line)[1:] for line in commands)
    assert (tmp_path / "own.yaml").read_text().endswith("extends: production_vector\n")
    flexroad(*catalog, "--tile-size", 60).expected(0)
    flexroad(*check).expected(0)
    assert "--config own.yaml" in " ".join(run)
    flexroad("--allow", downloads, *run, "--dry-run").expected(0)


def test_init_heights_for_roads_become_a_layer(downloads, flexroad):
    for tile in ("1", "2"):
        ground = np.full((60, 60), 99.98, np.float32)
        write(downloads / f"road_height/a_{tile}.tif", ground, WEST + 60 * (tile == "2"), NORTH)
    said = flexroad("init", downloads).expected(0).out
    assert "heights for roads: 2" in said
    (catalog,) = (line for line in said.splitlines() if line.startswith("flexroad catalog rasters"))
    flexroad(*shlex.split(catalog)[1:], "--tile-size", 60).expected(0)
    tiles = Catalog.read(shlex.split(catalog)[-1])
    assert {layer.name for tile in tiles.tiles for layer in tile.layers} >= {"dsm", "dtm", "road_height"}


def test_init_never_overwrites_configuration(downloads, flexroad, tmp_path):
    (tmp_path / "own.yaml").write_text("mine\n")
    assert "exists and is kept" in flexroad("init", downloads, "--write", "own.yaml").expected(2).err
    assert (tmp_path / "own.yaml").read_text() == "mine\n"


def test_init_names_unclear_files_with_their_question(downloads, flexroad):
    colours = np.zeros((60, 60), np.uint8)
    write(downloads / "what.tif", np.full((60, 60), 7.5, np.float32), WEST, NORTH)
    write(downloads / "ndsm.tif", np.full((60, 60), 7.5, np.float32), WEST, NORTH)
    write(downloads / "landcover.tif", colours + np.arange(60, dtype=np.uint8) % 3, WEST, NORTH)
    write(downloads / "dop.tif", np.full((60, 60), 7.5, np.float32), WEST, NORTH, crs=None)
    (downloads / "more.zip").write_bytes(b"PK")
    write_roads(downloads / "houses.gpkg", [box(WEST, NORTH - 9, WEST + 9, NORTH)])
    write_roads(downloads / "roads.gpkg", [LineString([(WEST, NORTH), (WEST + 9, NORTH)])], layer="lines")
    said = flexroad("init", downloads).expected(0).out
    for question in (
        "question: what.tif: is it a DSM (--dsm)",
        "question: ndsm.tif: heights above the ground",
        "question: landcover.tif: which of its values are road (--road-value)? It has 0, 1, 2",
        "question: dop.tif: it is named like an orthophoto, but has one band",
        "question: more.zip: unpack it first",
        "question: houses.gpkg: are these roads?",
        "question: roads.gpkg: which layer are the roads",
    ):
        assert question in said
    assert "  add --road-value with the values of the mask that are road" in said.splitlines()
    assert "houses.gpkg -o" not in said


def test_init_says_how_many_files_it_does_not_list(downloads, flexroad):
    for number in range(7):
        (downloads / f"part_{number}.zip").write_bytes(b"PK")
    lines = flexroad("init", downloads).expected(0).out.splitlines()
    start = lines.index("archives: 7")
    assert [line.split(".")[0] for line in lines[start + 1 : start + 6]] == [
        f"  part_{number}" for number in range(5)
    ]
    assert lines[start + 6] == "  and 2 more"


def test_init_folder_of_mixed_crs_gives_one_command_that_reprojects(downloads, flexroad):
    """The terrain is in the next zone, the mask in degrees."""
    (x,), (y,) = transform("EPSG:25832", "EPSG:25833", [WEST + 60], [NORTH - 30])
    for name in ("a_1.tif", "a_2.tif"):
        (downloads / "DGM" / name).unlink()
    ground = np.full((300, 300), 99, np.float32)
    write(downloads / "DGM" / "b.tif", ground, x - 150, y + 150, crs="EPSG:25833")
    (x,), (y,) = transform("EPSG:25832", "EPSG:4258", [WEST], [NORTH])
    road = np.full((60, 200), 1, np.uint8)
    write(downloads / "mask.tif", road, x - 1e-4, y + 1e-4, cell=1e-5, crs="EPSG:4258")
    said = flexroad("init", downloads).expected(0).out
    (catalog, check, _) = (
        shlex.split(line)[1:] for line in said.splitlines() if line.startswith("flexroad ")
    )
    assert "--reproject" in catalog
    noted = flexroad(*catalog, "--tile-size", 60).expected(0).err
    assert "dtm is in EPSG:25833, not EPSG:25832" in noted
    assert "road_mask is in EPSG:4258, not EPSG:25832" in noted
    assert "fail" not in flexroad(*check).out


def test_init_dsm_in_feet_asks_for_the_crs_of_the_tiles(downloads, flexroad):
    for name in ("DOM/a_1.tif", "DOM/a_2.tif", "DGM/a_1.tif", "DGM/a_2.tif"):
        write(downloads / name, np.full((60, 60), 9, np.float32), 985_000, 200_000, cell=3, crs="EPSG:2263")
    said = flexroad("init", downloads).expected(0).out
    assert " --reproject " in said
    assert "  add --to-crs with a CRS in metres" in said.splitlines()


def test_init_empty_folder_is_one_line(tmp_path, flexroad):
    (line,) = flexroad("init", tmp_path).expected(2).err.splitlines()
    assert line.startswith(f"error: {tmp_path} has no rasters")


def test_init_text_files_with_heights_are_rasters_and_others_are_not_shown(flexroad, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "downloads"
    for name in ("dom", "dgm"):
        write_xyz(folder / name / "a.txt", np.full((60, 60), 100.0), WEST, NORTH)
    (folder / "readme.txt").write_text("Heights of the survey, in metres.\n")
    said = flexroad("init", folder).expected(0).out
    assert "surface models (DSM): 1" in said
    assert "terrain models (DTM): 1" in said
    assert "readme" not in said
    (catalog,) = (line for line in said.splitlines() if line.startswith("flexroad catalog rasters"))
    flexroad(*shlex.split(catalog)[1:], "--tile-size", 60, "--crs", "EPSG:25832").expected(0)


def test_init_leaves_out_the_products_of_a_run(downloads, flexroad):
    assert downloads_module.RUN_FILE == RECORD
    before = flexroad("init", downloads).expected(0).out
    write(downloads / "run/tiles/1/dsm.tif", np.full((60, 60), 100, np.float32), WEST, NORTH)
    (downloads / "run/run.json").write_text("{}")
    assert flexroad("init", downloads).expected(0).out == before


def test_init_shows_scaled_integers_in_metres(downloads, flexroad):
    heights = np.full((60, 60), 2050, np.int16)
    write(downloads / "DOM/a_1.tif", heights, WEST, NORTH, scale=(0.01, 100.0))
    assert "DOM/a_1.tif: 1 band int16, 60 x 60, values 120.5 to 120.5" in flexroad("init", downloads).out
