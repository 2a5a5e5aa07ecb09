"""Files of a run and of its store under the names of others, as after fsck or a wrong restore."""

import shutil

import pandas as pd
import pytest

from flexroad.catalog import Catalog
from flexroad.pipeline.config.loading import load_config
from flexroad.pipeline.execute import SerialExecutor
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.run.runner import run_tiles
from tests.whole_run import products, rows

SETTINGS = ["fit.spacing_m=8"]


@pytest.fixture(scope="module")
def sound(made_survey, tmp_path_factory):
    """A finished run."""
    out = tmp_path_factory.mktemp("sound") / "run"
    run = Run.create(out, load_config("production", SETTINGS), Catalog.read(made_survey / "catalog.parquet"))
    run_tiles(run, SerialExecutor())
    return out


@pytest.fixture
def out(sound, tmp_path):
    shutil.copytree(sound, tmp_path / "run")
    return tmp_path / "run"


def rotate(paths):
    """Give each file the content of the next one."""
    contents = [path.read_bytes() for path in paths]
    for path, content in zip(paths, [*contents[1:], contents[0]], strict=True):
        path.write_bytes(content)


def again(out, **options):
    return run_tiles(Run.open(out), SerialExecutor(), **options)


def assert_equal(out, sound):
    assert products(out) == products(sound)
    pd.testing.assert_frame_equal(rows(out), rows(sound), check_exact=True)


@pytest.mark.parametrize("stage", ["border", "segment", "ecsrc", "fit", "sample", "evaluate", "assess", "*"])
def test_artefact_under_the_name_of_another_changes_no_result(stage, out, sound):
    """Those of one stage are of one type; of all stages, many get one of another type."""
    paths = sorted((out / "store").glob(f"{stage}/*/*.npz"))
    assert len(paths) > 2
    rotate(paths)
    shutil.rmtree(out / "tiles")
    (out / "database.txt").unlink()
    assert again(out).exit_code == 0
    assert_equal(out, sound)


def test_commands_that_read_a_run_use_no_artefact_of_another_name(out, flexroad, tmp_path):
    points = tmp_path / "points.csv"
    tile = Run.open(out).catalog.tiles[0]
    points.write_text(f"easting,northing\n{tile.grid.west + 9},{tile.grid.south + 9}\n")
    query = ("query", out, "--points", points)
    before = flexroad(*query).out
    rotate(sorted((out / "store").glob("*/*/*.npz")))
    assert flexroad(*query).out == before
    assert flexroad("report", out, "--format", "html").code == 0
    exported = flexroad("export", out, "--format", "landxml", "--output", tmp_path / "export")
    assert exported.code == 0, exported.err


@pytest.mark.parametrize("verify", [False, True])
def test_marker_of_another_tile_changes_no_result(verify, out, sound):
    rotate(sorted((out / "tiles").glob("*/item.json")))
    summary = again(out, verify=verify)
    assert (summary.cached, summary.exit_code) == (0, 0)
    assert_equal(out, sound)


def test_product_of_another_tile_is_written_again_with_verify(out, sound):
    for end in ("height.tif", "flexroad.glb", "surface.npz"):
        rotate(sorted((out / "tiles").glob(f"*/*{end}")))
    assert products(out) != products(sound)
    again(out, verify=True)
    assert_equal(out, sound)
