"""Catalog, sources, store and run in object storage: results as on disk, also with faulty storage."""

import io
import sys

import numpy as np
import pandas as pd
import pytest
import yaml
from PIL import Image
from shapely import LineString

from flexroad.catalog import Catalog, Grid
from flexroad.catalog.storage import paths
from flexroad.catalog.storage.paths import parse_location
from flexroad.pipeline.cli.main import main
from flexroad.pipeline.config.loading import compose
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.execute import SerialExecutor
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.run.runner import run_tiles
from flexroad.pipeline.run.sampler import RunSampler
from flexroad.pipeline.run.status import summary
from flexroad.pipeline.run.summary import read_summary
from flexroad.pipeline.store.artefacts import decode
from flexroad.pipeline.store.tables import read_metrics
from flexroad.tasks import TaskError
from flexroad.tasks.io.orthophoto import read_photo
from flexroad.tasks.io.vectors import Query, read_near
from flexroad.tasks.types import Source
from flexroad.tools.report import write_report
from flexroad.tools.results.run import open_run
from tests.conftest import QUICK
from tests.make_roads import write as write_roads
from tests.s3_server import Fault

pytestmark = [pytest.mark.slow, pytest.mark.soak("runs")]

LIGHT = {"extends": "defaults", "variants": {"plane": {"fit": "plane", "sample": "corners"}}}
CONFIG = compose(LIGHT, "light")


@pytest.fixture(scope="module")
def local(made_survey, tmp_path_factory):
    """The same run on disk, without faults."""
    return on_disk(made_survey, tmp_path_factory.mktemp("local"), CONFIG)


def on_disk(survey, folder, config):
    run = Run.create(folder, config, Catalog.read(survey / "catalog.parquet"))
    run_tiles(run, SerialExecutor())
    return run


@pytest.fixture
def survey(made_survey, bucket):
    """The survey, copied into a bucket."""
    home = bucket / "survey"
    for file in made_survey.rglob("*"):
        if file.is_file():
            paths.write(home / file.relative_to(made_survey).as_posix(), file.read_bytes())
    return home / "catalog.parquet"


@pytest.fixture
def run(survey, bucket):
    return Run.create(bucket / "run", CONFIG, Catalog.read(survey))


@pytest.fixture
def flexroad(monkeypatch, capsys):
    def call(*words) -> str:
        monkeypatch.setattr(sys, "argv", ["flexroad", *map(str, words)])
        with pytest.raises(SystemExit) as end:
            main()
        assert not end.value.code
        return capsys.readouterr().out

    return call


def bring_up_to_date(run):
    """Run all tiles; return the summary and the results by tile id."""
    results = []
    state = run_tiles(run, SerialExecutor(), watch=results.append)
    return state, {result.tile_id: result for result in results}


def assert_same(run, local):
    """Metrics and products are equal, products byte for byte."""
    actual, expected = (read_metrics(each.path).drop(columns="seconds") for each in (run, local))
    pd.testing.assert_frame_equal(actual, expected)
    for tile in run.catalog.tiles:
        folder, local_folder = (each.folder(tile.id).path for each in (run, local))
        names = paths.listing(folder).keys()
        assert names == paths.listing(local_folder).keys()
        for name in names - {"item.json"}:
            assert paths.read(folder / name) == paths.read(local_folder / name), name


def assert_files_complete(run):
    """All artefacts can be decoded; done tiles have all products with correct checksums."""
    for name in paths.listing(run.store):
        if name.endswith(".npz"):
            fingerprint = name.rpartition("/")[2].removesuffix(".npz")
            assert decode(paths.read(run.store / name), fingerprint)
    for tile in run.catalog.tiles:
        folder = run.folder(tile.id)
        assert folder.verified() == paths.exists(folder.path / "item.json")


def test_clean_removes_files_that_only_try_a_folder(run, flexroad):
    """A client that is killed leaves such a file in the run and in the store."""
    killed = [folder / f".probe-{'0a' * 16}" for folder in (run.path, run.store)]
    others = [run.path / ".probe-others", run.path / "mine" / killed[0].name]
    for file in (*killed, *others):
        paths.write(file, b"")
    flexroad("clean", run.path)
    assert not any(map(paths.exists, killed))
    assert all(map(paths.exists, others))


def test_run_in_bucket_equals_run_on_disk(survey, made_survey, bucket, tmp_path):
    config = compose(QUICK, "quick")
    local = on_disk(made_survey, tmp_path, config)
    run = Run.create(bucket / "run", config, Catalog.read(survey))
    state, results = bring_up_to_date(run)
    assert (state.exit_code, {result.status for result in results.values()}) == (0, {"done"})
    assert_same(run, local)
    state, results = bring_up_to_date(Run.open(parse_location(str(run.path))))
    assert (state.exit_code, {result.status for result in results.values()}) == (0, {"cached"})
    assert (state.done, state.cached, state.failed) == (4, 4, 0)


def test_report_tile_and_ground_of_run_in_bucket(run, local):
    run_tiles(run, SerialExecutor())
    opened = Run.open(run.path)
    assert (summary(opened).done, summary(opened).exit_code) == (4, 0)
    assert paths.read(write_report(opened, "html"))
    tile = opened.catalog.tiles[0]
    assert open_run(str(run.path)).tile(tile.id).identical(open_run(local.path).tile(tile.id))
    east, north = tile.grid.west + 10.3, tile.grid.north - 20.7
    actual, expected = (RunSampler.open(each.path).at(east, north) for each in (run, local))
    assert actual.height == expected.height
    assert list(actual.tile) == [tile.id]


def test_run_source_changed_recomputes_tile(run):
    run_tiles(run, SerialExecutor())
    tile = run.catalog.tiles[1]
    file = tile.paths(tile.layer("dsm"))[0]
    before = paths.stat(file)
    paths.write(file, paths.read(file) + b"\0")
    paths.write(file, paths.read(file)[:-1] + b"\1")
    assert paths.stat(file).size == before.size + 1
    state, results = bring_up_to_date(Run.open(run.path))
    assert {name for name, result in results.items() if result.status == "done"} == {tile.id}
    assert state.exit_code == 0


@pytest.mark.parametrize(
    "faults",
    [
        pytest.param([Fault("slow", first=2)], id="every request is throttled twice"),
        pytest.param([Fault("half", "GET", r"json|npz|parquet", first=1)], id="every answer breaks off once"),
        pytest.param(
            [
                # Four faults per path are one less than the attempts, in whatever order requests come.
                Fault(answer, first=1, share=0.25, seed=seed)
                for seed, answer in enumerate(("slow", "error", "cut", "shut"))
            ],
            id="requests fail in four ways in a row",
        ),
    ],
)
def test_run_with_temporary_storage_faults_completes(survey, bucket, storage, local, faults):
    storage.fail(*faults)
    run = Run.create(bucket / "run", CONFIG, Catalog.read(survey))
    state, _ = bring_up_to_date(run)
    storage.fail()
    assert (state.exit_code, state.done) == (0, 4)
    assert_same(run, local)


@pytest.mark.parametrize(("answer", "skip"), [("denied", 0), ("error", 20)])
def test_run_with_permanent_write_faults_fails_tiles(run, storage, local, answer, skip):
    storage.fail(Fault(answer, "PUT", "/run/(tiles|store)", skip=skip))
    state, results = bring_up_to_date(run)
    storage.fail()
    failed = {name for name, result in results.items() if result.status == "failed"}
    assert (state.exit_code, state.failed) == (1, len(failed))
    assert failed
    rows = read_metrics(run.path)
    assert set(rows[rows.status == "failed"].tile_id) == failed
    assert rows[rows.status == "failed"].error.str.contains(f"{run.path}/").all()
    assert read_summary(run.path)["exit_code"] == 1
    assert_files_complete(run)

    state, results = bring_up_to_date(Run.open(run.path))
    assert state.exit_code == 0
    assert {name for name, result in results.items() if result.status == "done"} == failed
    assert_same(run, local)


def test_run_storage_unreachable_keeps_done_tiles(run, storage, local):
    storage.fail(Fault("cut", path="/run/", skip=40))
    with pytest.raises(OSError, match=str(run.path)):
        run_tiles(run, SerialExecutor())
    storage.fail()
    assert_files_complete(run)
    state, _ = bring_up_to_date(Run.open(run.path))
    assert state.exit_code == 0
    assert_same(run, local)


@pytest.mark.parametrize("answer", ["slow", "denied", "half"])
def test_run_source_unreadable_fails_only_its_tile(run, storage, local, answer):
    tile = run.catalog.tiles[2]
    file = tile.paths(tile.layer("dsm"))[0]
    storage.fail(Fault(answer, "GET", f"/{file.path}"))
    state, results = bring_up_to_date(run)
    storage.fail()
    assert (state.exit_code, state.done, state.failed) == (1, 3, 1)
    (failure,) = results[tile.id].failures
    assert (failure.stage, failure.file) == ("load", str(file))

    state, results = bring_up_to_date(Run.open(run.path))
    assert state.exit_code == 0
    assert {name for name, result in results.items() if result.status == "done"} == {tile.id}
    assert_same(run, local)


def test_open_run_without_access_is_not_reported_as_missing(run, storage):
    storage.fail(Fault("denied"))
    with pytest.raises(ConfigError, match=r"cannot read s3://.*/run.json"):
        Run.open(run.path)
    storage.fail()
    with pytest.raises(ConfigError, match="is no run"):
        Run.open(run.path / "none")


def test_run_source_missing_names_its_address(run):
    tile = run.catalog.tiles[0]
    file = tile.paths(tile.layer("dtm"))[0]
    paths.remove(file)
    state, results = bring_up_to_date(run)
    (failure,) = results[tile.id].failures
    assert failure.file == str(file)
    assert "is missing" in failure.message
    assert (state.done, state.failed) == (3, 1)


def test_read_photo_with_world_file_equals_disk(bucket, tmp_path):
    grid = Grid("EPSG:25832", 295500.0, 5629500.0, 1.0, 40, 40)
    grey = np.random.default_rng(0).integers(0, 255, (80, 80), np.uint8)
    photo = tmp_path / "dop.tif"
    Image.fromarray(grey).save(photo)
    photo.with_suffix(".tfw").write_text("0.5\n0\n0\n-0.5\n295500.25\n5629499.75\n")
    for file in (photo, photo.with_suffix(".tfw")):
        paths.write(bucket / file.name, file.read_bytes())
    expected, actual = (
        read_photo(Source("dop", (home / "dop.tif",), grid.crs), grid) for home in (tmp_path, bucket)
    )
    assert actual.known.all()
    assert np.array_equal(actual.colour, expected.colour)


def test_read_near_roads_in_bucket_equal_disk(made_survey, survey, storage, tmp_path):
    crs, bounds = "EPSG:25832", (499900.0, 5599900.0, 500200.0, 5600200.0)
    folders = (made_survey, survey.parent)
    queries = [
        Query(folder / "roads.gpkg", None, None, ("highway", "width"), None, crs) for folder in folders
    ]
    storage.fail(Fault("half", "GET", "gpkg", first=1))
    expected, actual = (read_near(query, bounds) for query in queries)
    assert len(actual) > 3
    assert actual.equals(expected)
    # A new version of the file is read again; a file that cannot be read raises one line.
    write_roads(tmp_path / "one.gpkg", [LineString([(500000, 5600000), (500050, 5600000)])], width=[6])
    paths.write(queries[1].path, (tmp_path / "one.gpkg").read_bytes())
    assert len(read_near(queries[1], bounds)) == 1
    for answer in ("error", "half"):
        paths.write(queries[1].path, answer.encode())
        storage.fail(Fault(answer, "GET", "gpkg"))
        with pytest.raises(TaskError, match=r"s3://.*/roads.gpkg cannot be read: .*; run again"):
            read_near(queries[1], bounds)
    storage.fail()
    paths.remove(queries[1].path)
    with pytest.raises(TaskError, match=r"s3://.*/roads.gpkg cannot be opened .no such file.; put it back"):
        read_near(queries[1], bounds)


def test_run_artefact_damaged_is_recomputed(run, local):
    run_tiles(run, SerialExecutor())
    name = next(name for name in paths.listing(run.store) if name.startswith("evaluate/"))
    whole = paths.read(run.store / name)
    paths.write(run.store / name, whole[:-1])
    for tile in run.catalog.tiles:
        paths.remove(run.folder(tile.id).path / "item.json")
    _, results = bring_up_to_date(Run.open(run.path))
    assert sum(result.computed.get("evaluate", 0) for result in results.values()) == 1
    assert_same(run, local)


def test_run_cached_makes_few_requests(run, storage):
    storage.requests()
    run_tiles(run, SerialExecutor())
    first = storage.requests()
    # Requests per file and artefact: stat, write or read, stat. Headers of DSM and DTM are read once more.
    # Once in a run, files of levels that other settings may have left are looked for.
    assert (len(first) - 4) / 4 < 47
    run_tiles(Run.open(run.path), SerialExecutor())
    again = [path for _, path in storage.requests()]
    # One listing of the products, one per source folder, and the files of the run: mosaics, levels, tables.
    assert len(again) <= 24
    assert not [path for path in again if "/tiles/" in path or "/store/" in path or "/survey/" in path]


def test_commands_accept_s3_addresses(survey, bucket, tmp_path, local, flexroad):
    config = tmp_path / "light.yaml"
    config.write_text(yaml.safe_dump(LIGHT, sort_keys=False))
    home = str(bucket / "run")
    words = ["run", "--config", str(config), "--catalog", str(survey), "--out", home, "--executor", "dask"]
    flexroad(*words)
    assert_same(Run.open(bucket / "run"), local)
    assert "4 done" in flexroad("status", home)
    flexroad("report", home)
    assert paths.read(bucket / "run" / "report.md")
    tile = local.catalog.tiles[0]
    points = tmp_path / "points.csv"
    points.write_text(f"easting,northing\n{tile.grid.west + 10},{tile.grid.north - 10}\n")
    answer = pd.read_csv(io.StringIO(flexroad("query", home, "--points", points)))
    assert list(answer.tile) == [tile.id]
    assert np.isfinite(answer.height_m).all()
