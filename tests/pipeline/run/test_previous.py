"""Runs of earlier versions, and the metrics before the last execution that computed tiles, for the report."""

import pytest

from flexroad.catalog import Catalog
from flexroad.pipeline.config.loading import load_config
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.execute import SerialExecutor
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.run.runner import run_tiles
from flexroad.pipeline.store.tables import METRICS, PREVIOUS, read_metrics
from flexroad.tools.report import write_report


@pytest.fixture
def run(survey, quick_config, tmp_path):
    return Run.create(tmp_path / "run", load_config(quick_config), Catalog.read(survey))


def test_run_of_a_version_without_extends_keeps_its_options(run):
    file = run.path / "config.yaml"
    text = file.read_text()
    assert text.startswith("extends: defaults\n")
    file.write_text(text.removeprefix("extends: defaults\n"))
    assert Run.open(run.path).config.chains == run.config.chains
    assert run.config.chains["flexroad"]["fit"].method == "nurbs"


def touch(run):
    """Change the time of a tile's DSM, so that it is computed again."""
    tile = run.catalog.tiles[0]
    path = next(path for path in tile.paths(tile.layer("dsm")) if path.stem == tile.id)
    path.write_bytes(path.read_bytes())


def interrupted(result):
    """Interrupt at the first tile that is computed."""
    if result.status != "cached":
        raise KeyboardInterrupt


def test_run_that_computes_tiles_keeps_the_metrics_before(run):
    run_tiles(run, SerialExecutor())
    assert not (run.path / PREVIOUS).exists()
    before = (run.path / METRICS).read_bytes()
    touch(run)
    run_tiles(run, SerialExecutor())
    assert (run.path / PREVIOUS).read_bytes() == before
    assert len(read_metrics(run.path, PREVIOUS)) == len(read_metrics(run.path))


def test_run_without_work_keeps_the_metrics_of_the_last_change(run):
    run_tiles(run, SerialExecutor())
    before = (run.path / METRICS).read_bytes()
    touch(run)
    run_tiles(run, SerialExecutor())
    run_tiles(run, SerialExecutor())
    assert (run.path / PREVIOUS).read_bytes() == before


def test_interrupted_run_does_not_count(run):
    run_tiles(run, SerialExecutor())
    whole = (run.path / METRICS).read_bytes()
    touch(run)
    with pytest.raises(KeyboardInterrupt):
        run_tiles(run, SerialExecutor(), watch=interrupted)
    assert (run.path / PREVIOUS).read_bytes() == whole
    run_tiles(run, SerialExecutor())
    assert (run.path / PREVIOUS).read_bytes() == whole


@pytest.mark.slow
def test_report_compares_with_the_state_before(run):
    run_tiles(run, SerialExecutor())
    assert "Compared with" not in write_report(run, "html").read_text()
    touch(run)
    run_tiles(run, SerialExecutor())
    page = write_report(run, "html").read_text()
    assert "Compared with the state before the last run: 4 tiles done in both runs." in page


def test_report_names_damaged_metrics_before(run):
    run_tiles(run, SerialExecutor())
    (run.path / PREVIOUS).write_bytes(b"PAR1")
    with pytest.raises(ConfigError, match=r"metrics.previous.parquet is damaged: .*; remove it"):
        write_report(run, "html")
