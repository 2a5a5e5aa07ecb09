"""Why a run computes a tile: every reason, as `--dry-run` prints it, agrees with what the run then does."""

import os
import re
import shutil

import pytest
import yaml

from flexroad.catalog import Catalog
from tests.builders import LIGHT


@pytest.fixture
def config(tmp_path):
    (tmp_path / "light.yaml").write_text(yaml.safe_dump(LIGHT, sort_keys=False))
    return tmp_path / "light.yaml"


@pytest.fixture
def run(flexroad, survey, config, tmp_path):
    """Run the survey with a light configuration into ``tmp_path/run``."""

    def call(*words):
        out = ("--out", tmp_path / "run", "--executor", "serial")
        return flexroad("run", "--config", config, "--catalog", survey, *out, *words)

    return call


@pytest.fixture
def reasons(run):
    """The reasons in a dry run, in the order of the tiles, and its line of totals."""

    def call(*words) -> tuple[list[str], str]:
        lines = run("--dry-run", *words).out.splitlines()
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
    run("--dry-run").expected(1)
    run().expected(1)
    assert reasons()[0][3].startswith("failed last time: load: TaskError: ")
    shutil.move(kept, dtm)
    assert reasons()[0][3].startswith("failed last time: ")
    assert computed(run().expected(0)) == 1


@pytest.mark.slow
def test_file_that_comes_and_goes_is_told_by_dry_run_counts_and_rerun(survey, flexroad, tmp_path):
    """In production a file also belongs to the neighbours: only the tile that it lies on fails."""
    out = tmp_path / "run"
    words = ("run", "--catalog", survey, "--out", out)
    run = (*words, "--executor", "serial")
    assert flexroad(*words, "--dry-run").expected(0).out.splitlines()[-1] == "expected exit code: 0"
    flexroad(*run).expected(0)
    first, *others = (tile.id for tile in Catalog.read(survey).tiles)
    file = survey.parent / "dsm" / f"{first}.tif"
    kept = file.rename(tmp_path / "kept.tif")

    dry = flexroad(*words, "--dry-run").expected(1)
    lines = dry.out.splitlines()
    beside = f"source changed: {file}, which is missing"
    assert lines[:4] == [f"{first}: file missing: {file}", *(f"{other}: {beside}" for other in others)]
    assert lines[4] == "4 tiles: 3 source changed, 1 file missing"
    assert dry.out.splitlines()[-1] == "expected exit code: 1 (1 tile would fail)"
    said = flexroad(*run).expected(1)
    assert "4 tiles: 3 done (0 cached), 1 failed, 0 pending; 0 new, 4 changed, 0 vanished; " in said.out
    said = flexroad(*run).expected(1)
    assert "4 tiles: 3 done (3 cached), 1 failed, 0 pending; 0 new, 0 changed, 0 vanished; " in said.out

    shutil.move(kept, file)
    assert flexroad(*words, "--dry-run").expected(0).out.splitlines()[-1] == "expected exit code: 0"
    said = flexroad("rerun", out, "--tile", first, "--executor", "serial").expected(1)
    assert "4 tiles: 1 done (0 cached), 0 failed, 3 pending; 0 new, 4 changed, 0 vanished; " in said.out
    why = f"  {', '.join(others)}: source changed: dsm/{file.name}, which was missing"
    assert said.out.splitlines()[1:] == [
        why,
        f"3 tiles have no result of the present files and options; next: flexroad rerun {out}",
    ]
    assert f"{why}; `flexroad rerun {out}` computes it" in flexroad("status", out).expected(0).out
    dry = flexroad(*words, "--tile", first, "--dry-run").expected(1)
    assert dry.out.splitlines()[-1] == "expected exit code: 1 (3 other tiles pending or failed)"
    flexroad("rerun", out, "--executor", "serial").expected(0)

    (survey.parent / "dsm").rename(tmp_path / "unmounted")
    for command in ((*words, "--dry-run"), run):
        (error,) = flexroad(*command).expected(2).errors
        assert error.startswith("error: each of the 4 tiles lacks a file, for example ")


def test_missing_file_that_is_back_is_no_change_of_checksum(run, reasons, survey):
    """Size and time of a missing file are not recorded: two values in place of three, as with --checksum."""
    tile = Catalog.read(survey).tiles[0]
    dsm = path(tile, "dsm")
    kept = dsm.rename(survey.parent / "kept.tif")
    run().expected(1)
    shutil.move(kept, dsm)
    settings = reasons("--set", "load.halo_m=10")[0]
    assert not [line for line in settings if "checksum" in line]


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
def test_reasons_name_the_first_stage_that_changed(
    survey, flexroad, tmp_path, words, line, light_run, config
):
    out = shutil.copytree(light_run.path, tmp_path / "run")
    run = ("run", "--config", config, "--catalog", survey, "--out", out, *words)
    said = flexroad(*run, "--dry-run").expected(0).out.splitlines()
    assert [text.partition(": ")[2] for text in said[:4]] == [line] * 4
    assert computed(flexroad(*run, "--executor", "serial").expected(0)) == 4
