"""A catalog that is run from Python, against the command line."""

import pytest

import flexroad
from flexroad.catalog import Catalog
from tests.whole_run import products, rows


class Events(flexroad.Observer):
    """Keeps the events of a run."""

    def __init__(self):
        self.names = []

    def start(self, tiles, selected):
        self.names.append(f"start {tiles} {selected}")

    def tile(self, result):
        self.names.append(result.status)

    def end(self, summary):
        self.names.append(f"end {summary.exit_code}")


@pytest.fixture
def run(survey, quick_config, tmp_path):
    def run(**options):
        return flexroad.run(survey, quick_config, out=tmp_path / "run", workers=1, **options)

    return run


def test_run_from_python_equals_the_command(run, survey, quick_config, tmp_path, flexroad):
    view = run()
    words = ["--catalog", survey, "--config", quick_config, "--out", tmp_path / "other"]
    flexroad("run", *words, "--executor", "serial").expected(0)
    assert products(tmp_path / "run") == products(tmp_path / "other")
    assert rows(tmp_path / "run").equals(rows(tmp_path / "other"))
    assert set(view.tiles["state"]) == {"done"}
    assert (tmp_path / "run" / "tiles.geojson").exists()


def test_run_again_computes_nothing(run):
    first, second = Events(), Events()
    run(observer=first)
    run(observer=second)
    assert first.names == ["start 4 4", *["done"] * 4, "end 0"]
    assert second.names == ["start 4 4", *["cached"] * 4, "end 0"]


def test_run_of_some_tiles_and_rerun_of_the_failed_one(run, survey):
    tiles = Catalog.read(survey).tiles
    file = tiles[0].paths(tiles[0].layer("dsm"))[0]
    data = file.read_bytes()
    file.write_bytes(b"")
    events = Events()
    view = run(tiles=[tile.id for tile in tiles[:2]], observer=events)
    assert events.names == ["start 2 2", "failed", "done", "end 1"]
    assert list(view.failures["tile_id"]) == [tiles[0].id]
    file.write_bytes(data)
    events = Events()
    again = view.rerun(failed=True, workers=1, observer=events)
    assert events.names == ["start 2 1", "done", "end 0"]
    assert set(again.tiles["state"]) == {"done"}


def test_run_with_invalid_option_or_unknown_tile_raises_and_writes_nothing(run, tmp_path):
    with pytest.raises(flexroad.ConfigError, match="fit.spacing"):
        run(settings=["fit.spacing=3"])
    with pytest.raises(flexroad.CatalogError, match="no tile 'none'|none"):
        run(tiles=["none"])
    assert not (tmp_path / "run").exists()


def test_catalog_from_warns_of_a_file_that_cannot_be_used(survey, tmp_path):
    layers = {"dsm": "dsm/*.tif", "dtm": "dtm/*.tif", "road_mask": "road_mask/*.tif"}
    bad = next((survey.parent / "dtm").glob("*.tif"))
    bad.write_bytes(b"")
    with pytest.warns(UserWarning, match=f"skipped dtm/{bad.name}"):
        path = flexroad.catalog_from(survey.parent, tmp_path / "c.json", tile_size_m=60, **layers)
    assert len(Catalog.read(path).tiles) == 4
