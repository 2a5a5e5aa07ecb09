"""The reader of a run's results: from the store, or computed."""

import pytest

from flexroad.catalog import Catalog
from flexroad.pipeline.config.loading import compose
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.execute import SerialExecutor
from flexroad.pipeline.run.finished import FinishedTile, RunPlace, open_variant
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.run.runner import run_tiles
from flexroad.pipeline.run.status import peek_statuses
from flexroad.tools.report.content import gather
from flexroad.tools.report.pictures import tile_pictures
from tests.builders import LIGHT


@pytest.fixture
def run(survey, tmp_path):
    """A run of four tiles, of which the first one is finished."""
    catalog = Catalog.read(survey)
    run = Run.create(tmp_path / "run", compose(LIGHT, "light"), catalog)
    run_tiles(run, SerialExecutor(), only=lambda tile: tile == catalog.tiles[0])
    return run


def tile_of(run, number=0, variant="flexroad"):
    (status,) = peek_statuses(run, [run.catalog.tiles[number]])
    return FinishedTile.of(run, status, variant)


def test_stored_results_of_a_finished_tile_are_not_computed(run):
    tile = tile_of(run)
    assert len(tile.mesh.faces)
    assert tile.metrics.l2_road_m > 0
    spans = tile.evaluator.spans
    assert {name: (span.computed, span.reused) for name, span in spans.items()} == {
        "sample": (0, 1),
        "evaluate": (0, 1),
    }


def test_results_of_an_unfinished_tile_are_computed_and_not_stored(run):
    files = set(run.store.rglob("*"))
    tile = tile_of(run, 1)
    assert len(tile.mesh.faces)
    assert tile.evaluator.spans["fit"].computed == 1
    assert set(run.store.rglob("*")) == files


def test_variants_of_a_tile_share_what_they_have_in_common(run):
    tile = tile_of(run, 1)
    other = tile.in_variant("rgt")
    assert len(other.mesh.faces) > len(tile.mesh.faces)
    assert other.data is tile.data
    assert tile.evaluator.spans["load"].computed == 1
    assert tile.evaluator.spans["fit"].computed == 2


def test_result_that_cannot_be_computed_names_tile_and_file(run, survey):
    (survey.parent / "dsm" / f"{run.catalog.tiles[0].id}.tif").unlink()
    tile = tile_of(run)
    assert len(tile.mesh.faces)
    with pytest.raises(ConfigError, match=f"^tile {tile.id}: load: .*{tile.id}.tif"):
        _ = tile.data


def test_pictures_of_a_tile_without_source_files_say_why_they_are_missing(run, survey):
    (survey.parent / "dsm" / f"{run.catalog.tiles[0].id}.tif").unlink()
    content = gather(run)
    (pictures,) = [each for each in tile_pictures(run, content) if each.tile_id == run.catalog.tiles[0].id]
    assert not pictures.pictures
    (note,) = pictures.notes
    assert note.startswith("No pictures: load: ")


def test_stored_surface_and_mask_are_none_if_one_is_missing(run):
    place, nodes = RunPlace.of(run), tile_of(run).snapshot.nodes
    surface, road = place.stored(nodes["fit"], nodes["segment"])
    assert surface.height(*road.core.origin) > 0
    assert place.stored(nodes["fit"], "") is None
    assert place.stored("", nodes["segment"]) is None


def test_open_variant_takes_the_first_exported_variant_by_default(run):
    opened, variant = open_variant(run.path)
    assert (opened.path, variant) == (run.path, run.config.export.variants[0])
    assert open_variant(run.path, "rgt")[1] == "rgt"
    with pytest.raises(ConfigError, match=r"run has no variant 'x'; it has rgt, flexroad"):
        open_variant(run.path, "x")
