import json
import shutil
from datetime import UTC, datetime

import geopandas
import pytest
import shapely

from flexroad.catalog import Grid, Tile
from flexroad.tasks.roads.attributes import level_numbers
from flexroad.tools.check import catalog as catalog_check
from flexroad.tools.check.catalog import Deck
from flexroad.tools.synthetic.crossings import Crossings
from flexroad.tools.synthetic.scenes import write_scenes
from tests.make_town import make_town
from tests.permissions import permissions_enforced

SEED = 15
LEVELS = ["bridge", "tunnel", "layer", "level"]
LINE = "1 place looks like decks; no road there has a level"


@pytest.fixture(scope="module")
def scenes(tmp_path_factory):
    """The catalog of tiles with one deck across their borders; their roads have no levels."""
    catalog = write_scenes(tmp_path_factory.mktemp("scenes"), 4, SEED, size_m=60, decks=True)
    roads = geopandas.read_file(catalog.with_name("roads.gpkg"))
    roads.drop(columns=LEVELS).to_file(catalog.with_name("roads.gpkg"), layer="roads")
    return catalog


@pytest.fixture
def unnamed(scenes, tmp_path):
    """The catalog of a copy, to change."""
    return shutil.copytree(scenes.parent, tmp_path / "town") / scenes.name


@pytest.fixture
def told(flexroad):
    """Check a catalog with an exit code of 0; return the lines on decks."""

    def check(catalog, *options):
        lines = flexroad("catalog", "check", catalog, *options).expected(0).out.splitlines()
        return [line for line in lines if "look" in line]

    return check


@pytest.mark.parametrize("config", ["production", "production_vector", "paper"])
def test_deck_over_a_border_is_mapped_once(unnamed, told, config):
    path = unnamed.with_name("decks.geojson")
    (line,) = told(unnamed, "--config", config)
    assert line == f"{LINE}: check {path}, then give roads there a level"
    found = geopandas.read_file(path)
    assert found.crs == "EPSG:4326"
    (row,) = found.to_crs("EPSG:25832").to_dict("records")
    assert (row["level"], row["kind"], row["ends"]) == (1, "deck", 2)
    (true,) = (
        area
        for area in Crossings(SEED).areas(1, (499_980, 5_599_980, 500_100, 5_600_100))
        if area.intersects(row["geometry"])
    )
    assert shapely.intersection(true, row["geometry"]).area > 0.75 * row["geometry"].area
    assert row["area_m2"] == pytest.approx(row["geometry"].area, rel=0.002)
    assert 4 < row["rise_m"] < 8
    # As a road file it names the level.
    assert level_numbers(found)[0].tolist() == [1]


@pytest.mark.parametrize("column", ["bridge", "level"])
def test_named_deck_is_not_mapped(unnamed, told, column):
    assert told(unnamed)
    roads = geopandas.read_file(unnamed.with_name("roads.gpkg"))
    (deck,) = geopandas.read_file(unnamed.with_name("decks.geojson")).to_crs(roads.crs).geometry
    over = roads.intersects(deck) & (roads.highway == "secondary") & (roads.length < 100)
    # The main road is cut at the ends of decks: the shortest piece is the deck.
    piece = roads[over].length.idxmin()
    roads[column] = [{"bridge": "yes", "level": 1}[column] if i == piece else None for i in roads.index]
    roads.to_file(unnamed.with_name("roads.gpkg"), layer="roads")
    assert told(unnamed) == []
    # The map of an earlier check is removed.
    assert not unnamed.with_name("decks.geojson").exists()


def test_edited_map_is_kept(unnamed, told):
    path = unnamed.with_name("decks.geojson")
    told(unnamed)
    before = path.read_bytes()
    assert told(unnamed)[0].startswith(f"{LINE}: check {path}")
    assert path.read_bytes() == before
    edited = json.loads(before)
    del edited["generator"]
    path.write_text(json.dumps(edited))
    assert told(unnamed) == [f"{LINE}; {path} was edited and is not replaced: rename it, and check again"]
    assert json.loads(path.read_text()) == edited


def test_folder_that_cannot_be_written_is_one_line(unnamed, told):
    unnamed.parent.chmod(0o555)
    try:
        with permissions_enforced():
            (line,) = told(unnamed)
    finally:
        unnamed.parent.chmod(0o755)
    path = unnamed.with_name("decks.geojson")
    assert line == (
        f"{LINE}; {path} cannot be written (Permission denied): "
        "check a copy of the catalog in a folder that can be written"
    )


def test_tiles_in_local_coordinates_have_no_map(tmp_path):
    site = 'LOCAL_CS["my site",UNIT["metre",1],AXIS["Easting",EAST],AXIS["Northing",NORTH]]'
    deck = Deck(shapely.box(0, 0, 9, 9), 6.0, 2)
    tile = Tile("a", Grid(site, 0, 60, 1.0, 60, 60), (), "", datetime.now(UTC))
    (line,) = catalog_check._written(tmp_path / "decks.geojson", [(tile, deck)])
    assert line.text == f"{LINE}; no map of them, as their CRS has no place on the Earth"
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("ends", "words"),
    [
        ([2], "1 place looks like decks"),
        ([2, 3], "2 places look like decks"),
        ([2, 3, 1], "2 places look like decks, 1 like decks or roofs"),
        ([0], "1 place looks like decks or roofs"),
        ([1, 0], "2 places look like decks or roofs"),
    ],
)
def test_places_that_may_be_roofs_are_counted_apart(tmp_path, ends, words):
    tile = Tile("a", Grid("EPSG:25832", 0, 60, 1.0, 60, 60), (), "", datetime.now(UTC))
    found = [(tile, Deck(shapely.box(0, 0, 9, 9), 6.0, number)) for number in ends]
    (line,) = catalog_check._written(tmp_path / "decks.geojson", found)
    assert line.text.startswith(f"{words}; no road there has a level: check {tmp_path}")


def test_large_catalog_is_mapped_if_asked_for(unnamed, told, monkeypatch):
    monkeypatch.setattr(catalog_check, "MOST_TILES", 3)
    path = unnamed.with_name("decks.geojson")
    (line,) = told(unnamed)
    assert line == f"{LINE}, on 3 of 4 tiles: look at all with --decks"
    assert not path.exists()
    assert told(unnamed, "--decks")[0].startswith(f"{LINE}: check {path}")
    assert path.exists()


@pytest.mark.parametrize("config", ["production", "production_vector"])
def test_decks_and_tunnels_of_an_osm_file_are_named(tmp_path, told, config):
    catalog = make_town(tmp_path, size_m=60)
    assert told(catalog, "--config", config) == []
    tags = catalog.with_name("town.osm")
    tags.write_text(tags.read_text().replace('k="bridge"', 'k="note"'))
    assert told(catalog, "--config", config)[0].startswith(f"{LINE}: check")


def test_catalog_without_roads_or_decks_has_no_line(survey, told):
    assert told(survey) == []
    assert not survey.with_name("decks.geojson").exists()
