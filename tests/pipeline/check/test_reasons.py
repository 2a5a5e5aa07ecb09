"""Why a run computes a tile: every reason, as `--dry-run` prints it, agrees with what the run then does."""

import os
import re
import shutil

import pytest
import yaml

from flexroad.catalog import Catalog
from tests.whole_run import LIGHT


@pytest.fixture
def run(flexroad, survey, tmp_path):
    """Run the survey with a light configuration into ``tmp_path/run``."""
    config = tmp_path / "light.yaml"
    config.write_text(yaml.safe_dump(LIGHT, sort_keys=False))

    def call(*words):
        out = ("--out", tmp_path / "run", "--executor", "serial")
        return flexroad("run", "--config", config, "--catalog", survey, *out, *words)

    return call


@pytest.fixture
def reasons(run):
    """The reasons in a dry run, in the order of the tiles, and its line of totals."""

    def call(*words) -> tuple[list[str], str]:
        lines = run("--dry-run", *words).expected(0).out.splitlines()
        return [line.partition(": ")[2] for line in lines[:4]], lines[4]

    return call


def computed(said) -> int:
    """The number of tiles that a run computed."""
    done, cached = re.search(r"(\d+) done \((\d+) cached", said.out).groups()
    return int(done) - int(cached)


def path(tile, layer):
    return tile.paths(tile.layer(layer))[0]


def test_reasons_name_changed_files_and_failures(run, reasons, survey, tmp_path):
    whole = Catalog.read(survey)
    Catalog(whole.tiles[1:]).write(survey)
    run().expected(0)
    Catalog(whole.tiles).write(survey)
    _, source, product, failing = whole.tiles
    os.utime(path(source, "dsm"), (1, 1))
    next((tmp_path / "run" / "tiles" / product.id).glob("*.glb")).unlink()
    assert reasons() == (
        ["new", f"source changed: dsm/{source.id}.tif", "product missing", "up to date"],
        "4 tiles: 1 new, 1 source changed, 1 product missing, 1 up to date",
    )
    assert computed(run().expected(0)) == 3
    assert reasons() == (["up to date"] * 4, "4 tiles: 4 up to date")
    dtm = path(failing, "dtm")
    kept = dtm.rename(tmp_path / "kept.tif")
    assert reasons()[0][3] == f"file missing: {dtm}"
    run().expected(1)
    assert reasons()[0][3].startswith("failed last time: load: TaskError: ")
    shutil.move(kept, dtm)
    assert reasons()[0][3].startswith("failed last time: ")
    assert computed(run().expected(0)) == 1


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (("--set", "fit.iterations=4"), "settings or version changed: fit"),
        (("--set", "ecsrc.theta_z_m=0.4"), "settings or version changed: ecsrc"),
        (("--set", "load.min_valid=0.1"), "settings or version changed: load"),
        (("--set", "segment=vector"), "source changed: now reads roads"),
        (("--set", "export.formats=[glb]"), "settings or version changed: export"),
        (("--set", "variants.other={fit: plane}"), "settings or version changed: variant other"),
        (("--checksum",), "settings or version changed: --checksum"),
    ],
)
def test_reasons_name_the_first_stage_that_changed(made_survey, flexroad, tmp_path, words, line, light):
    out = shutil.copytree(light, tmp_path / "run")
    config = light.with_name("light.yaml")
    run = ("run", "--config", config, "--catalog", made_survey / "catalog.parquet", "--out", out, *words)
    said = flexroad(*run, "--dry-run").expected(0).out.splitlines()
    assert [text.partition(": ")[2] for text in said[:4]] == [line] * 4
    assert computed(flexroad(*run, "--executor", "serial").expected(0)) == 4


@pytest.fixture(scope="module")
def light(made_survey, flexroad, tmp_path_factory):
    """The folder of a finished run, which tests must not change."""
    folder = tmp_path_factory.mktemp("light")
    (folder / "light.yaml").write_text(yaml.safe_dump(LIGHT, sort_keys=False))
    words = ("--catalog", made_survey / "catalog.parquet", "--out", folder / "run", "--executor", "serial")
    flexroad("run", "--config", folder / "light.yaml", *words).expected(0)
    return folder / "run"
