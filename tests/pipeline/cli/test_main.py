"""Output and exit codes of the command line."""

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import typer

from flexroad.catalog import Catalog
from flexroad.pipeline.cli.main import app
from flexroad.pipeline.store.tables import read_metrics
from tests.command_line import call, process


def flexroad(*words, expect: int = 0) -> str:
    said = call(*words).expected(expect)
    return said.out if expect == 0 else said.out + said.err


@pytest.fixture(scope="module")
def words(made_survey, tmp_path_factory) -> list:
    """The words of a run command over the complete survey, without --out and --executor."""
    config = tmp_path_factory.mktemp("cli") / "quick.yaml"
    config.write_text(
        "extends: defaults\nfit: {control_points: [12, 12], iterations: 30}\n"
        "variants:\n"
        "  plane: {fit: plane, sample: corners}\n"
        "  rgt: {fit: raster, sample: uniform}\n"
        "  flexroad: {}\n"
    )
    return ["run", "--config", config, "--catalog", made_survey / "catalog.parquet"]


@pytest.fixture(scope="module")
def finished(words, tmp_path_factory) -> Path:
    """A finished run of the complete survey, made by the command line."""
    out = tmp_path_factory.mktemp("cli") / "run"
    said = flexroad(*words, "--out", out, "--executor", "serial")
    assert "4 tiles: 4 done (0 cached), 0 failed, 0 pending" in said
    return out


@pytest.mark.slow
def test_run_with_worker_processes_equals_serial_run(words, finished, tmp_path):
    said = process(*words, "--out", tmp_path / "run", "--executor", "dask", "--workers", 2).expected(0)
    assert "4 tiles: 4 done (0 cached), 0 failed, 0 pending" in said.out
    tables = [read_metrics(run).drop(columns="seconds") for run in (finished, tmp_path / "run")]
    pd.testing.assert_frame_equal(*tables, check_exact=True)


def parsed(*words) -> dict:
    """The parameters of a command after parsing, unchecked."""
    command = typer.main.get_command(app)
    for name in words[: 2 if words[0] == "catalog" else 1]:
        command = command.get_command(None, name)
    rest = list(words[words.index(command.name) + 1 :])
    return command.make_context(command.name, rest, resilient_parsing=True).params


def test_parse_repeatable_option_takes_several_values():
    run = parsed("run", "--tile", "a", "b", "--out", "x")
    assert (run["tile"], run["out"]) == (["a", "b"], Path("x"))
    rasters = parsed("catalog", "rasters", "root", "--road-value", "1", "-3", "-o", "c.json")
    assert (rasters["road_value"], rasters["root"]) == ([1, -3], Path("root"))
    rerun = parsed("rerun", "--tile", "a", "RUN")
    assert (rerun["tile"], rerun["path"]) == (["a"], Path("RUN"))


def test_parse_tile_ids_may_begin_with_a_minus():
    """West of a CRS's origin."""
    run = parsed("run", "--tile", "-500_250", "-750_-250", "0_-250", "--out", "x")
    assert (run["tile"], run["out"]) == (["-500_250", "-750_-250", "0_-250"], Path("x"))


@pytest.mark.slow
def test_figures_writes_page_and_drawings(finished, tmp_path):
    tile = Catalog.read(finished / "catalog.parquet").tiles[1].id
    said = flexroad("figures", "--tile", tile, finished, "-o", tmp_path)
    assert str(tmp_path / "figures.md") in said
    assert tile in (tmp_path / "figures.md").read_text()
    # A run without the variants of the ablation has only these figures.
    drawn = ["dataset.pdf", "error_and_smoothness.pdf", "road_profile.pdf"]
    assert sorted(path.name for path in tmp_path.glob("*.pdf")) == drawn
    assert "no tile '0_0'" in flexroad("figures", finished, "--tile", "0_0", "-o", tmp_path, expect=2)


def test_status_of_finished_run_counts_tiles(finished):
    values = json.loads(flexroad("status", finished, "--json"))
    counts = {key: values[key] for key in ("tiles", "done", "failed", "cached", "pending")}
    assert counts == {"tiles": 4, "done": 4, "failed": 0, "cached": 0, "pending": 0}
    assert values["failures"] == []
    assert "4 tiles: 4 done" in flexroad("status", finished)


def test_rerun_unchanged_is_cached_and_noted(finished):
    said = flexroad("rerun", finished, "--executor", "serial")
    assert "4 done (4 cached)" in said
    assert "nothing had changed" in said


def test_query_writes_csv_with_heights(finished, made_survey, tmp_path):
    catalog = Catalog.read(made_survey / "catalog.parquet")
    grid = catalog.tiles[0].grid
    points = tmp_path / "points.csv"
    points.write_text(f"name,easting,northing\nin,{grid.west + 30.2},{grid.south + 20.7}\nout,0,0\n")
    answers = tmp_path / "answers.csv"
    answers.write_text(flexroad("query", finished, "--points", points))
    table = pd.read_csv(answers)
    assert list(table.columns) == [
        "name", "easting", "northing", "height_m", "nx", "ny", "nz", "tile", "class", "flags",
    ]  # fmt: skip
    inside, outside = table.iloc[0], table.iloc[1]
    assert inside.tile == catalog.tiles[0].id
    assert inside["class"] in ("road", "terrain")
    assert np.linalg.norm(inside[["nx", "ny", "nz"]].astype(float)) == pytest.approx(1)
    assert inside.nz > 0.7
    assert 0 < inside.height_m < 400
    assert np.isnan(outside.height_m)
    assert pd.isna(outside.tile)
    assert "needs easting and northing" in flexroad(
        "query", finished, "--points", _without_columns(tmp_path), expect=2
    )
    assert "has no variant 'x'" in flexroad("query", finished, "--points", points, "--variant", "x", expect=2)


def _without_columns(folder: Path) -> Path:
    path = folder / "no_columns.csv"
    path.write_text("a,b\n1,2\n")
    return path


def test_ground_at_rgt_equals_dsm(finished, made_survey):
    import rasterio

    from flexroad.pipeline.run.sampler import RunSampler

    tile = Catalog.read(made_survey / "catalog.parquet").tiles[1]
    with rasterio.open(tile.paths(tile.layer("dsm"))[0]) as raster:
        dsm = raster.read(1)
    answer = RunSampler.open(finished, "rgt").at(tile.grid.eastings[[5, 40]], tile.grid.northings[[7, 50]])
    assert answer.height == pytest.approx([dsm[7, 5], dsm[50, 40]], abs=1e-5)


@pytest.mark.parametrize("form", ["md", "csv", pytest.param("html", marks=pytest.mark.slow)])
def test_report_writes_every_format(finished, form):
    said = flexroad("report", finished, "--format", form)
    text = (finished / f"report.{form}").read_text()
    if form != "html":
        assert said.strip() == text.strip()
    assert "flexroad" in text
    if form == "md":
        assert "| method | tiles | L2 road (m) |" in text
        assert "Steps between neighbouring tiles" in text
        assert "no fault" in text
    if form == "html":
        assert text.count("data:image/webp;base64,") >= 4 * 6
        assert "Did it work?" in text
        assert "http" not in text.split("<body>")[1].split("Configuration")[0]


def test_run_dry_run_prints_a_line_per_tile_and_writes_nothing(made_survey, tmp_path):
    words = ["--config", "paper", "--catalog", made_survey / "catalog.parquet", "--out", tmp_path / "r"]
    said = flexroad("run", *words, "--dry-run").splitlines()
    assert not (tmp_path / "r").exists()
    ids = [tile.id for tile in Catalog.read(made_survey / "catalog.parquet").tiles]
    assert said[:5] == [*(f"{name}: new" for name in ids), "4 tiles: 4 new"]
    assert "12 to do" in said[-2]
    assert said[-1] == "expected exit code: 0"
    graph = flexroad("run", *words, "--dry-run", "--verbose")
    assert graph.count("fit ") == 4 * 3 + 1
    assert "(plane, rgt, flexroad)" in graph


def test_run_with_tile_or_bbox_selects_tiles(made_survey, tmp_path):
    catalog = Catalog.read(made_survey / "catalog.parquet")
    one, two = catalog.tiles[0], catalog.tiles[3]
    said = flexroad(
        "run", "--config", "paper", "--catalog", made_survey / "catalog.parquet", "--out", tmp_path / "r",
        "--tile", one.id, two.id, "--executor", "serial", "--dry-run",
    )  # fmt: skip
    assert [line for line in said.splitlines() if line.endswith(": new")] == [
        f"{one.id}: new",
        f"{two.id}: new",
    ]
    west, south, east, north = two.grid.bounds
    said = flexroad(
        "run", "--config", "paper", "--catalog", made_survey / "catalog.parquet", "--out", tmp_path / "r",
        "--bbox", west + 1, south + 1, east - 1, north - 1, "--dry-run",
    )  # fmt: skip
    assert f"{two.id}: new" in said
    assert one.id not in said


def test_run_with_tile_keeps_other_tiles_of_the_run(survey, tmp_path):
    catalog = Catalog.read(survey)
    config = tmp_path / "c.yaml"
    config.write_text("extends: defaults\nfit: {control_points: [12, 12], iterations: 5}\n")
    words = [
        "run",
        "--config",
        config,
        "--catalog",
        survey,
        "--out",
        tmp_path / "run",
        "--executor",
        "serial",
    ]
    one, two = catalog.tiles[3].id, catalog.tiles[1].id
    assert "1 tile: 1 done (0 cached)" in flexroad(*words, "--tile", one)
    assert "2 tiles: 2 done (0 cached)" in flexroad(*words, "--tile", two)
    table = pd.read_parquet(tmp_path / "run" / "metrics.parquet")
    assert table.tile_id.tolist() == [two, one]
    assert "4 tiles: 4 done (2 cached)" in flexroad(*words)


def test_run_with_failed_tile_exits_with_1(survey, tmp_path):
    catalog = Catalog.read(survey)
    tile = catalog.tiles[2]
    path = tile.paths(tile.layer("dtm"))[0]
    path.unlink()
    config = tmp_path / "c.yaml"
    config.write_text("extends: defaults\nfit: {control_points: [12, 12], iterations: 5}\n")
    words = ["--config", config, "--catalog", survey, "--out", tmp_path / "run", "--executor", "serial"]
    said = flexroad("run", *words, expect=1)
    assert f"failed {tile.id}: load: TaskError: " in said
    assert "3 done (0 cached), 1 failed" in said
    (failure,) = json.loads(flexroad("status", tmp_path / "run", "--json"))["failures"]
    assert (failure["tile_id"], failure["stage"]) == (tile.id, "load")
    assert failure["file"] == str(path)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["run", "--config", "papr", "--catalog", "CAT", "--out", "OUT"], "did you mean paper?"),
        (["run", "--config", "paper", "--catalog", "nowhere.parquet", "--out", "OUT"], "does not exist"),
        (["run", "--config", "paper", "--catalog", "CAT", "--out", "FILE/x"], "cannot write the run"),
        (["run", "--config", "paper", "--catalog", "CAT", "--out", "OUT", "--tile", "1_2"], "did you mean"),
        (
            [*"run --config paper --catalog CAT --out OUT --executor tcp://127.0.0.1:9".split()],
            "does not answer",
        ),
        (["run", "--config", "paper"], "Missing option"),
        (["status", "FILE"], "is no run"),
        (["catalog", "show", "FILE"], "is not a FlexRoad catalog"),
        (["config", "show", "nope"], "no configuration 'nope'"),
    ],
)
def test_command_that_cannot_start_exits_with_2(words, message, made_survey, tmp_path, monkeypatch):
    monkeypatch.setattr("flexroad.pipeline.execute.clusters.ANSWER_S", 1)
    (tmp_path / "file").write_text("")
    places = {
        "CAT": made_survey / "catalog.parquet",
        "OUT": tmp_path / "out",
        "FILE": tmp_path / "file",
        "FILE/x": tmp_path / "file" / "x",
    }
    said = flexroad(*[places.get(word, word) for word in words], expect=2)
    assert message in said
    assert "Traceback" not in said


def test_process_that_cannot_start_prints_one_line_and_exits_with_2():
    said = process("config", "show", "papr").expected(2)
    assert said.out == ""
    (line,) = said.err.splitlines()
    assert "did you mean paper?" in line


def test_config_commands_print_options():
    assert "paper" in flexroad("config", "show")
    assert "theta_z_m: 0.5" in flexroad("config", "show", "paper")
    assert "theta_z_m: 0.25" in flexroad("config", "template")
    assert "theta_z_m" in json.dumps(json.loads(flexroad("config", "schema"))["properties"]["ecsrc"])


def test_catalog_show_lists_layers_and_count(made_survey):
    said = flexroad("catalog", "show", made_survey / "catalog.parquet")
    assert said.splitlines()[-1] == "4 tiles, EPSG:25832"
    assert "dsm(4) dtm(4) road_mask(4) reference(4) reference_road(4)" in said


def test_train_setting_that_cannot_be_read_gives_one_line(flexroad):
    command = ["train", "none.json", "--labels", "mask", "-o", "x.safetensors", "--set"]
    for setting, message in {
        f"rounds={'9' * 5000}": "--set rounds: not readable as YAML: line 1, column 1: a number of more than",
        "rounds=[": "--set rounds: not readable as YAML",
        "rounds": "--set 'rounds': give KEY=VALUE, like --set epochs=100",
    }.items():
        (line,) = flexroad(*command, setting).expected(2).errors
        assert message in line


def test_interrupted_command_says_so(tmp_path, monkeypatch):
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(Catalog, "read", interrupted)
    said = call("catalog", "check", tmp_path / "catalog.parquet").expected(130)
    assert (said.out, said.err) == ("", "interrupted; repeat the command\n")
