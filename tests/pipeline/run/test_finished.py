"""Readers of a run's results, which are stored or computed, and folders that a run may be written to."""

import re

import pytest

from flexroad.catalog import Catalog
from flexroad.catalog.storage import paths
from flexroad.pipeline.config.loading import compose
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.execute import SerialExecutor
from flexroad.pipeline.run.finished import FinishedTile, RunPlace, open_variant
from flexroad.pipeline.run.record import Run, check_folder
from flexroad.pipeline.run.runner import run_tiles
from flexroad.pipeline.run.status import peek_statuses
from flexroad.pipeline.run.summary import Summary, write_summary
from flexroad.tools.report.content import gather
from flexroad.tools.report.pictures import tile_pictures
from tests.builders import LIGHT
from tests.permissions import permissions_enforced


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
    """Also in place of the pictures of the report."""
    (survey.parent / "dsm" / f"{run.catalog.tiles[0].id}.tif").unlink()
    tile = tile_of(run)
    assert len(tile.mesh.faces)
    (pictures,) = [each for each in tile_pictures(run, gather(run)) if each.tile_id == tile.id]
    assert not pictures.pictures
    (note,) = pictures.notes
    assert note.startswith("No pictures: load: ")
    with pytest.raises(ConfigError, match=f"^tile {tile.id}: load: .*{tile.id}.tif"):
        _ = tile.data


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


# --- folders that a run may be written to -------------------------------------------------------------


@pytest.fixture(params=["disk", pytest.param("bucket", marks=pytest.mark.slow)])
def folder(request, tmp_path):
    return tmp_path if request.param == "disk" else request.getfixturevalue("bucket")


def fill(folder, *names):
    for name in names:
        paths.write(folder / name, b"mine")


@pytest.mark.parametrize(
    "names",
    [
        ["catalog.parquet", "config.yaml", "height.vrt", "collection.json"],
        ["tiles/32_356_5699.tif"],
        ["store/readme.txt"],
        ["summary.json"],
        ["notes.txt", "lock.json", "log.jsonl"],
    ],
)
def test_folder_with_files_of_others_is_refused(folder, names):
    fill(folder, *names)
    before = paths.listing(folder)
    other = names[0].partition("/")[0]
    message = f"{folder} has files that are not of a run, such as {other}; choose an empty or new folder"
    with pytest.raises(ConfigError, match=re.escape(message)):
        check_folder(folder)
    assert paths.listing(folder) == before


@pytest.mark.parametrize(
    "names",
    [
        [],
        [".DS_Store", ".Trash-0/a", "lost+found/a"],
        ["lock.json", "log.jsonl"],
        # One sign of a run is enough.
        *(
            ["config.yaml", "notes.txt", sign]
            for sign in ("run.json", "tiles/a/item.json", "tiles/b/failed.json", "store/fit/ab/ab.npz")
        ),
    ],
)
def test_folder_without_files_of_others_or_of_a_run_is_accepted(folder, names):
    fill(folder, *names)
    check_folder(folder)
    check_folder(folder / "new" / "run")


def test_folder_with_a_summary_of_a_run_is_accepted(folder):
    fill(folder, "config.yaml", "notes.txt")
    write_summary(folder, Summary(1, 1, 0, 0, 0))
    check_folder(folder)


def test_folder_that_cannot_be_read_is_refused(tmp_path):
    (tmp_path / "run").mkdir(mode=0o000)
    with permissions_enforced(), pytest.raises(ConfigError, match="cannot read .*run: Permission denied; "):
        check_folder(tmp_path / "run")
