"""Runs on both executors: which nodes are computed, which are reused, and how failures are recorded."""

import hashlib
import json
import os
from collections import Counter

import numpy as np
import pandas as pd
import pystac
import pytest
import rasterio
import trimesh

from flexroad.catalog import Catalog
from flexroad.pipeline.config.loading import compose
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.execute import DaskExecutor, SerialExecutor
from flexroad.pipeline.graph.graph import Pattern
from flexroad.pipeline.run.api import rerun_filter
from flexroad.pipeline.run.events import EventLog
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.run.runner import run_tiles
from flexroad.pipeline.run.status import summary
from flexroad.pipeline.store.tables import METRICS, PREVIOUS, read_metrics
from flexroad.tools.report import steps, write_report
from flexroad.tools.report.content import LARGEST_STEPS, gather
from flexroad.tools.report.pictures import relief
from flexroad.tools.report.steps import edge_steps
from tests.builders import LIGHT
from tests.conftest import QUICK
from tests.whole_run import rows

FIXED = (
    "tile_id variant method stratum status l2_road_m l2_terrain_m rmse_road_m rmse_terrain_m nmad_road_m "
    "p95_road_m mad_road_deg mad_terrain_deg triangles road_fraction completeness seconds error"
).split()
PAPER = {"load": 1, "segment": 1, "ecsrc": 1, "fit": 3, "sample": 3, "evaluate": 3, "assess": 3, "export": 1}
"""Nodes of one tile with the paper's three variants; shared nodes are computed once."""
EACH = PAPER | {"fit": 2, "sample": 2, "evaluate": 2, "assess": 2}
"""Nodes of one tile with the two variants of ``LIGHT``."""


def results_of(run, executor=None, *arguments) -> list:
    results = []
    run_tiles(run, executor or SerialExecutor(), *arguments, watch=results.append)
    return results


def computed(results) -> Counter:
    return sum((Counter(result.computed) for result in results), Counter())


def times(n: int, counts=EACH) -> Counter:
    return Counter({stage: n * count for stage, count in counts.items()})


def changed(run: Run, **stages) -> Run:
    return Run.create(run.path, compose({**LIGHT, **stages}, "changed"), run.catalog)


def own_file(run, number):
    tile = run.catalog.tiles[number]
    return tile.paths(tile.layer("dsm"))[0]


# --- one run, on each executor ------------------------------------------------------------------------


@pytest.fixture(scope="module")
def of_executor(made_survey, tmp_path_factory):
    """Return a run with the paper's variants, and its results, by an executor."""

    def made(executor):
        folder = tmp_path_factory.mktemp("made") / "run"
        run = Run.create(folder, compose(QUICK, "quick"), Catalog.read(made_survey / "catalog.parquet"))
        return run, results_of(run, executor)

    return made


@pytest.fixture(scope="module")
def serial(of_executor):
    return of_executor(SerialExecutor())


@pytest.fixture(scope="module")
def dask(of_executor, cluster):
    return of_executor(DaskExecutor(scheduler=cluster.scheduler_address))


@pytest.fixture(params=["serial", "dask"])
def made(request):
    return request.getfixturevalue(request.param)


def test_run_writes_all_rows_and_computes_shared_nodes_once(made):
    run, results = made
    assert computed(results) == times(4, PAPER)
    table = read_metrics(run.path)
    assert list(table.columns[: len(FIXED)]) == FIXED
    assert list(zip(table.tile_id, table.variant, table.method, strict=True)) == [
        (tile.id, variant, method)
        for tile in run.catalog.tiles
        for variant, method in (("plane", "plane"), ("rgt", "raster"), ("flexroad", "nurbs"))
    ]
    assert set(table.status) == {"done"}
    assert (table.seconds > 0).all()
    assert list(table[table.variant == "rgt"].triangles) == [2 * 59**2] * 4
    assert list(table[table.variant == "plane"].triangles) == [2] * 4
    assert table.completeness.min() > 0.99


def test_executors_give_equal_tables(serial, dask):
    pd.testing.assert_frame_equal(rows(serial[0].path), rows(dask[0].path), check_exact=True)


def test_log_has_one_event_per_tile_and_stage(made):
    run, _ = made
    events = [json.loads(line) for line in (run.path / "log.jsonl").read_text().splitlines()]
    kinds = Counter(event["event"] for event in events)
    assert kinds == {"run": 1, "stage": 4 * len(PAPER), "tile": 4, "end": 1}
    stages = [event for event in events if event["event"] == "stage"]
    for tile in run.catalog.tiles:
        by_stage = {event["stage"]: event for event in stages if event["tile"] == tile.id}
        assert {stage: event["computed"] for stage, event in by_stage.items()} == PAPER
        assert by_stage["fit"]["bytes"] > 1000
        assert by_stage["load"]["bytes"] == 0
    assert all(event["peak_mb"] > 10 and event["pid"] and event["host"] for event in stages)


def test_products_have_checksums_and_open_in_standard_readers(made):
    run, _ = made
    tile = run.catalog.tiles[0]
    folder = run.folder(tile.id).path
    item = pystac.Item.from_file(str(folder / "item.json"))
    assert item.id == tile.id
    assert set(item.assets) == {"mesh", "ply", "height", "road", "height_source", "surface"}
    names = {asset.href for asset in item.assets.values()}
    assert {path.name for path in folder.iterdir()} == names | {"item.json"}
    for asset in item.assets.values():
        data = (folder / asset.href).read_bytes()
        assert asset.extra_fields["file:checksum"] == "1220" + hashlib.sha256(data).hexdigest()
    assert set(trimesh.load(folder / f"{tile.id}_flexroad.glb").geometry) == {"road", "terrain"}
    cloud = trimesh.load(folder / f"{tile.id}_flexroad.ply", process=False)
    west, south, east, north = tile.grid.hull
    assert np.allclose(cloud.bounds[:, :2], [[west, south], [east, north]], atol=1e-6)
    with rasterio.open(folder / f"{tile.id}_flexroad_height.tif") as raster:
        assert tuple(raster.bounds) == tile.grid.bounds
        assert raster.crs.to_epsg() == 25832


# --- another run of the same folder -------------------------------------------------------------------


def test_repeated_run_computes_nothing(own_run, executor):
    before = read_metrics(own_run.path)
    results = results_of(Run.open(own_run.path), executor)
    assert {result.status for result in results} == {"cached"}
    assert computed(results) == Counter()
    pd.testing.assert_frame_equal(before, read_metrics(own_run.path), check_exact=True)
    counts = summary(own_run)
    assert (counts.tiles, counts.done, counts.cached, counts.failed, counts.pending) == (4, 4, 4, 0, 0)


@pytest.mark.parametrize(
    ("stages", "expected"),
    [
        # Results of load and meshes that are not exported are not stored, so they are computed again.
        (
            {"evaluate": {"nearest": True}},
            {"load": 1, "sample": 1, "fit": 1, "evaluate": 2, "export": 1},
        ),
        ({"ecsrc": {"theta_z_m": 0.1}}, {stage: EACH[stage] for stage in EACH if stage != "segment"}),
        ({"variants": {"smooth": {}}}, {"export": 1}),
    ],
)
def test_changed_option_computes_its_stage_and_dependents(stages, expected, own_run):
    assert computed(results_of(changed(own_run, **stages))) == times(4, expected)
    table = read_metrics(own_run.path)
    assert table.nearest_road_m.notna().all() == ("evaluate" in stages)
    assert set(table.variant) == set(stages.get("variants", LIGHT["variants"]))
    assert computed(results_of(changed(own_run))) == times(4, {"export": 1})
    assert set(read_metrics(own_run.path).variant) == set(LIGHT["variants"])


def test_changed_source_computes_only_its_tile(own_run):
    with rasterio.open(own_file(own_run, 1), "r+") as raster:
        raster.write(raster.read(1) + 0.5, 1)
    results = results_of(Run.open(own_run.path))
    found = {result.tile_id: result.status for result in results if result.status != "cached"}
    assert found == {own_run.catalog.tiles[1].id: "done"}
    assert computed(results) == times(1)


def test_shared_store_is_reused_by_another_run(own_run, executor, tmp_path):
    other = Run.create(tmp_path / "other", own_run.config, own_run.catalog, own_run.store)
    assert computed(results_of(other, executor)) == times(4, {"export": 1})
    assert not (tmp_path / "other" / "store").exists()
    left, right = (read_metrics(run.path) for run in (own_run, other))
    pd.testing.assert_frame_equal(left, right, check_exact=True)
    assert Run.open(other.path).store == own_run.store.resolve()


def test_forced_stages_are_computed_again(own_run, executor):
    one = rerun_filter(own_run, (own_run.catalog.tiles[3].id,), failed=False)
    results = results_of(own_run, executor, one, frozenset({"fit", "sample", "evaluate"}))
    assert computed(results) == times(1, {"load": 1, "fit": 2, "sample": 2, "evaluate": 2, "export": 1})


def test_tiles_of_an_older_version_are_exported_again_from_the_store(own_run, monkeypatch):
    for name in ("tasks.products.cog.VERSION", "pipeline.graph.graph.ITEM_VERSION"):
        monkeypatch.setattr(f"flexroad.{name}", 10**6)
        assert computed(results_of(Run.open(own_run.path))) == times(4, {"export": 1})


def test_broken_source_fails_only_its_tile(survey, tmp_path, executor):
    run = Run.create(tmp_path / "run", compose(LIGHT, "light"), Catalog.read(survey))
    path, broken = own_file(run, 2), run.catalog.tiles[2].id
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    results = results_of(run, executor)
    assert {result.tile_id for result in results if result.status == "failed"} == {broken}
    table = read_metrics(run.path)
    assert len(table) == 8
    bad = table[table.tile_id == broken]
    assert set(bad.status) == {"failed"}
    assert bad.error.str.startswith("load: TaskError: ").all()
    assert bad.l2_road_m.isna().all()
    assert set(table[table.tile_id != broken].status) == {"done"}
    counts = summary(run)
    assert (counts.done, counts.failed) == (3, 1)
    (failure,) = counts.failures
    assert (failure.tile_id, failure.file) == (broken, str(path))
    assert pd.read_csv(run.path / "failures.csv").tile_id.astype(str).tolist() == [broken]
    # The failed tile is chosen, or a given one.
    failed = rerun_filter(run, (), failed=True)
    assert [result.tile_id for result in results_of(run, executor, failed)] == [broken]
    one = run.catalog.tiles[3].id
    results = results_of(run, executor, rerun_filter(run, (one,), failed=False))
    assert [(result.tile_id, result.status) for result in results] == [(one, "cached")]
    assert len(read_metrics(run.path)) == 8

    path.write_bytes(whole)
    fixed = results_of(run, executor, rerun_filter(run, (), failed=True))
    # The restored file has another time, so the recorded failure is of another graph: the tile is pending.
    fixed = fixed or results_of(run, executor)
    assert computed(fixed) == times(1)
    assert summary(run).failed == 0


def test_missing_source_keeps_result_until_tile_is_processed(own_run):
    own_file(own_run, 1).unlink()
    assert (summary(own_run).done, summary(own_run).pending) == (4, 0)
    other = rerun_filter(own_run, (own_run.catalog.tiles[0].id,), failed=False)
    for only, expected in ((other, (4, 1, 0)), (lambda tile: True, (3, 3, 1))):
        counts = run_tiles(own_run, SerialExecutor(), only)
        assert (counts.done, counts.cached, counts.failed) == expected
    assert counts.failures[0].tile_id == own_run.catalog.tiles[1].id


def test_summary_counts_new_changed_and_vanished_tiles(survey, tmp_path):
    catalog, config = Catalog.read(survey), compose(LIGHT, "light")
    first = Run.create(tmp_path / "run", config, Catalog(catalog.tiles[:3]))
    counts = run_tiles(first, SerialExecutor())
    assert (counts.new, counts.changed, counts.vanished, counts.exit_code) == (3, 0, 0, 0)
    tile = catalog.tiles[1]
    os.utime(tile.paths(tile.layer("dtm"))[0], (1, 1))
    second = Run.create(first.path, config, Catalog(catalog.tiles[1:]))
    assert [summary(second).pending, summary(second).done] == [2, 1]
    counts = run_tiles(second, SerialExecutor())
    expected = {"new": 1, "changed": 1, "vanished": 1, "tiles": 3, "done": 3, "cached": 1, "exit_code": 0}
    told = json.loads((first.path / "summary.json").read_text())
    for name, value in expected.items():
        assert getattr(counts, name) == told[name] == value
    assert told["start"] < told["end"]
    assert list(read_metrics(first.path).tile_id.unique()) == [tile.id for tile in second.catalog.tiles]
    assert run_tiles(second, SerialExecutor()).vanished == 0


class CallBeforeTile(SerialExecutor):
    """Calls a function before the n-th tile is processed, after its graph was made."""

    def __init__(self, n, call):
        self.n, self.call = n, call

    def map(self, function, jobs, lost, probe=None):
        for i, job in enumerate(jobs):
            if i == self.n:
                self.call()
            yield function(job)


def interrupt():
    raise KeyboardInterrupt


def test_interrupted_run_writes_tables_and_summary(survey, tmp_path):
    run = Run.create(tmp_path / "run", compose(LIGHT, "light"), Catalog.read(survey))
    with pytest.raises(KeyboardInterrupt):
        run_tiles(run, CallBeforeTile(2, interrupt))
    told = json.loads((run.path / "summary.json").read_text())
    assert [told[name] for name in ("interrupted", "exit_code", "done", "pending")] == [True, 130, 2, 2]
    assert read_metrics(run.path).tile_id.nunique() == 2
    counts = run_tiles(run, SerialExecutor())
    assert (counts.done, counts.cached, counts.interrupted, counts.exit_code) == (4, 2, False, 0)


def test_interrupted_run_drops_rows_of_earlier_configuration(own_run):
    with pytest.raises(KeyboardInterrupt):
        run_tiles(changed(own_run, evaluate={"nearest": True}), CallBeforeTile(1, interrupt))
    table = read_metrics(own_run.path)
    assert list(table.tile_id.unique()) == [own_run.catalog.tiles[0].id]
    assert table.nearest_road_m.notna().all()


def assert_nothing_to_do(run) -> None:
    """Execute a finished run; fail if a tile is processed."""
    before = read_metrics(run.path)
    counts = run_tiles(run, CallBeforeTile(0, lambda: pytest.fail("a tile was processed")))
    assert (counts.done, counts.cached) == (4, 4)
    pd.testing.assert_frame_equal(before, read_metrics(run.path), check_exact=True)


def counted_graphs(monkeypatch) -> Counter:
    """Count the graphs that are made of each tile from now on."""
    graph, made = Pattern.graph, Counter()

    def counted(self, tile, *arguments):
        made[tile.id] += 1
        return graph(self, tile, *arguments)

    monkeypatch.setattr(Pattern, "graph", counted)
    return made


def test_resume_makes_each_graph_once_and_reads_no_marker(own_run, monkeypatch):
    made = counted_graphs(monkeypatch)
    monkeypatch.setattr(
        "flexroad.pipeline.run.status._from_marker", lambda *_: pytest.fail("a marker was read")
    )
    assert_nothing_to_do(Run.open(own_run.path))
    assert made == {tile.id: 1 for tile in own_run.catalog.tiles}


def test_outdated_database_is_restored_from_markers(own_run):
    """As if the client had been killed before it wrote any record."""
    database = own_run.path / "database.txt"
    before = database.read_bytes()
    run = changed(own_run, evaluate={"nearest": True})
    run_tiles(run, SerialExecutor())
    database.write_bytes(before)
    assert summary(run).done == 4
    assert_nothing_to_do(run)
    assert read_metrics(run.path).nearest_road_m.notna().all()


def test_metrics_before_the_last_execution_that_computed_tiles_are_kept(own_run):
    def again(watch=lambda result: None):
        """Change the time of a tile's DSM, and run."""
        path = own_file(own_run, 0)
        path.write_bytes(path.read_bytes())
        run_tiles(own_run, SerialExecutor(), watch=watch)

    def interrupted(result):
        if result.status != "cached":
            raise KeyboardInterrupt

    metrics, previous = own_run.path / METRICS, own_run.path / PREVIOUS
    assert not previous.exists()
    first = metrics.read_bytes()
    again()
    second = metrics.read_bytes()
    run_tiles(own_run, SerialExecutor())
    assert previous.read_bytes() == first != second
    # An interrupted run does not count.
    before = metrics.read_bytes()
    with pytest.raises(KeyboardInterrupt):
        again(interrupted)
    run_tiles(own_run, SerialExecutor())
    assert previous.read_bytes() == before
    previous.write_bytes(b"PAR1")
    with pytest.raises(ConfigError, match=r"metrics.previous.parquet is damaged: .*; remove it"):
        write_report(own_run, "html")


@pytest.mark.slow
def test_report_compares_with_the_state_before(own_run):
    run_tiles(own_run, SerialExecutor(), force=frozenset({"export"}))
    page = write_report(own_run, "html").read_text()
    assert "Compared with the state before the last run: 4 tiles done in both runs." in page


# --- steps and relief of the report -------------------------------------------------------------------


def test_edge_steps_of_large_run_are_a_sample(light_run, monkeypatch):
    results = gather(light_run).results
    check, whole, note = edge_steps(light_run, results)
    assert (len(whole), note) == (4, "")
    assert list(check.result) == ["tiles are fitted independently"]
    monkeypatch.setattr(steps, "MOST", 2)
    _, part, note = edge_steps(light_run, results)
    pairs = ["tile", "neighbour"]
    assert 0 < len(part) < len(whole)
    chosen = pd.MultiIndex.from_frame(part[pairs])
    assert part.set_index(pairs).equals(whole.set_index(pairs).loc[chosen])
    assert note == "Of one tile in 2, against its neighbours in the east and north."


def test_report_checks_every_tile_once(light_run, monkeypatch):
    checked = counted_graphs(monkeypatch)
    content = gather(light_run)
    assert len(content.tables[LARGEST_STEPS][0]) == 4
    picture = relief(light_run, light_run.catalog.tiles, content.results)
    assert list(picture.places) == [tile.id for tile in light_run.catalog.tiles]
    assert checked == dict.fromkeys(picture.places, 1)


def test_relief_has_tiles_with_results_in_the_store(own_run):
    first, second, *others = own_run.catalog.tiles
    stored = gather(own_run).results["flexroad"]
    results = {"flexroad": {tile.id: stored[tile.id] for tile in (first, second)}}
    (surface,) = own_run.store.glob(f"fit/*/{results['flexroad'][first.id][0]}.npz")
    surface.unlink()
    assert list(relief(own_run, own_run.catalog.tiles, results).places) == [second.id]
    assert relief(own_run, others, results) is None


# --- the log ------------------------------------------------------------------------------------------


def test_run_with_pipe_as_log_does_not_wait_for_a_reader(own_run):
    log = own_run.path / "log.jsonl"
    log.unlink()
    os.mkfifo(log)
    assert run_tiles(own_run, SerialExecutor(), force=frozenset({"export"})).done == 4
    assert log.is_fifo()


@pytest.mark.parametrize("before", ["", '{"event": "end"}\n', '{"event": "e', "\0\0"])
def test_log_with_cut_off_line_gets_whole_lines(before, tmp_path):
    (tmp_path / "log.jsonl").write_text(before)
    with EventLog(tmp_path) as log:
        log.note("run")
    *_, last = (tmp_path / "log.jsonl").read_text().splitlines()
    assert json.loads(last)["event"] == "run"
    assert (tmp_path / "log.jsonl").read_text().startswith(before)


def test_log_on_full_disk_raises_nothing(tmp_path):
    # /dev/full rejects every write, as a full disk does.
    (tmp_path / "log.jsonl").symlink_to("/dev/full")
    with EventLog(tmp_path) as log:
        log.note("run")
