"""Runs on both executors: which nodes are computed, which are reused, and how failures are recorded."""

import json
import os
import shutil
from collections import Counter
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import rasterio

from flexroad.catalog import Catalog
from flexroad.pipeline.config.loading import compose, load_config
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.execute import DaskExecutor, SerialExecutor
from flexroad.pipeline.graph.graph import Pattern
from flexroad.pipeline.run.api import rerun_filter
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.run.runner import run_tiles
from flexroad.pipeline.run.status import summary
from flexroad.pipeline.run.summary import Summary
from flexroad.pipeline.store.artefacts import ArtefactStore
from flexroad.pipeline.store.tables import read_metrics
from flexroad.pipeline.worker.tile import TileResult
from flexroad.tools.report import steps
from flexroad.tools.report.content import LARGEST_STEPS, gather
from flexroad.tools.report.pictures import relief
from flexroad.tools.report.steps import edge_steps
from tests.conftest import QUICK

FIXED = (
    "tile_id variant method stratum status l2_road_m l2_terrain_m rmse_road_m rmse_terrain_m nmad_road_m "
    "p95_road_m mad_road_deg mad_terrain_deg triangles road_fraction completeness seconds error"
).split()
EACH = {"load": 1, "segment": 1, "ecsrc": 1, "fit": 3, "sample": 3, "evaluate": 3, "assess": 3, "export": 1}
"""Nodes of one tile with the paper's three variants; shared nodes are computed once."""


@pytest.fixture
def run(survey, quick_config, tmp_path):
    return Run.create(tmp_path / "run", load_config(quick_config), Catalog.read(survey))


@pytest.fixture(scope="module")
def made(made_survey, tmp_path_factory) -> Path:
    """The folder of a finished run, for copying."""
    folder = tmp_path_factory.mktemp("made") / "run"
    run = Run.create(folder, compose(QUICK, "quick"), Catalog.read(made_survey / "catalog.parquet"))
    run_tiles(run, SerialExecutor())
    return folder


@pytest.fixture
def finished(made, run):
    """A finished run with its own survey, which the test may change."""
    shutil.copytree(made, run.path, dirs_exist_ok=True)
    return Run.create(run.path, run.config, run.catalog)


def computed(results) -> Counter:
    total = Counter()
    for result in results:
        total.update(result.computed)
    return total


def results_of(run, executor, *arguments) -> list[TileResult]:
    results = []
    run_tiles(run, executor, *arguments, watch=results.append)
    return results


def times(n: int, counts=EACH) -> Counter:
    return Counter({stage: n * count for stage, count in counts.items()})


def changed(run: Run, **stages) -> Run:
    raw = {**run.config.raw, **stages}
    return Run.create(run.path, compose(raw, "changed"), run.catalog)


def truncate(run: Run, index: int, layer: str = "dsm") -> tuple[str, bytes]:
    """Cut a source file of a tile in half; return the tile's id and the original bytes."""
    tile = run.catalog.tiles[index]
    path = tile.paths(tile.layer(layer))[0]
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    return tile.id, whole


def test_run_writes_all_rows_and_computes_shared_nodes_once(run, executor):
    results = results_of(run, executor)
    assert computed(results) == times(4)
    rows = read_metrics(run.path)
    assert list(rows.columns[: len(FIXED)]) == FIXED
    assert list(zip(rows.tile_id, rows.variant, rows.method, strict=True)) == [
        (tile.id, variant, method)
        for tile in run.catalog.tiles
        for variant, method in (("plane", "plane"), ("rgt", "raster"), ("flexroad", "nurbs"))
    ]
    assert set(rows.status) == {"done"}
    assert (rows.seconds > 0).all()
    assert list(rows[rows.variant == "rgt"].triangles) == [2 * 59**2] * 4
    assert list(rows[rows.variant == "plane"].triangles) == [2] * 4
    assert rows.completeness.min() > 0.99


def test_executors_give_equal_tables(survey, quick_config, tmp_path, cluster):
    tables = []
    for name, executor in (("a", SerialExecutor()), ("b", DaskExecutor(scheduler=cluster.scheduler_address))):
        run = Run.create(tmp_path / name, load_config(quick_config), Catalog.read(survey))
        run_tiles(run, executor)
        tables.append(read_metrics(run.path).drop(columns="seconds"))
    pd.testing.assert_frame_equal(*tables, check_exact=True)


def test_repeated_run_computes_nothing(finished, executor):
    before = read_metrics(finished.path)
    results = results_of(Run.open(finished.path), executor)
    assert {result.status for result in results} == {"cached"}
    assert computed(results) == Counter()
    pd.testing.assert_frame_equal(before, read_metrics(finished.path), check_exact=True)
    counts = summary(finished)
    assert (counts.tiles, counts.done, counts.cached, counts.failed, counts.pending) == (4, 4, 4, 0, 0)


def test_changed_option_computes_its_stage_and_dependents(finished, executor):
    again = results_of(changed(finished, evaluate={"nearest": True}), executor)
    # Results of load and meshes that are not exported are not stored, so they are computed again.
    assert computed(again) == times(4, {"load": 1, "sample": 2, "fit": 1, "evaluate": 3, "export": 1})
    assert read_metrics(finished.path).nearest_road_m.notna().all()
    back = results_of(changed(finished), executor)
    assert computed(back) == times(4, {"export": 1})


def test_changed_filter_reuses_segmentation(finished, executor):
    again = results_of(changed(finished, ecsrc={"theta_z_m": 0.1}), executor)
    assert computed(again) == times(4, EACH) - times(4, {"segment": 1})


def test_changed_source_computes_only_its_tile(finished, executor):
    tile = finished.catalog.tiles[1]
    path = tile.paths(tile.layer("dsm"))[0]
    with rasterio.open(path, "r+") as raster:
        heights = raster.read(1)
        raster.write(heights + 0.5, 1)
    results = results_of(Run.open(finished.path), executor)
    assert {r.tile_id: r.status for r in results if r.status != "cached"} == {tile.id: "done"}
    assert computed(results) == times(1)


def test_shared_store_is_reused_by_another_run(finished, executor, tmp_path):
    other = Run.create(tmp_path / "other", finished.config, finished.catalog, finished.store)
    assert computed(results_of(other, executor)) == times(4, {"export": 1})
    assert not (tmp_path / "other" / "store").exists()
    left, right = (read_metrics(r.path) for r in (finished, other))
    pd.testing.assert_frame_equal(left, right, check_exact=True)
    assert Run.open(other.path).store == finished.store.resolve()


def test_broken_source_fails_only_its_tile(run, executor):
    broken, whole = truncate(run, 2)
    results = results_of(run, executor)
    assert {r.tile_id for r in results if r.status == "failed"} == {broken}
    rows = read_metrics(run.path)
    assert len(rows) == 12
    bad = rows[rows.tile_id == broken]
    assert set(bad.status) == {"failed"}
    assert bad.error.str.startswith("load: TaskError: ").all()
    assert bad.l2_road_m.isna().all()
    assert set(rows[rows.tile_id != broken].status) == {"done"}
    counts = summary(run)
    assert (counts.done, counts.failed) == (3, 1)
    (failure,) = counts.failures
    assert failure.tile_id == broken
    assert failure.file.endswith(f"{broken}.tif")
    assert pd.read_csv(run.path / "failures.csv").tile_id.astype(str).tolist() == [broken]

    tile = run.catalog.tiles[2]
    tile.paths(tile.layer("dsm"))[0].write_bytes(whole)
    fixed = results_of(run, executor, rerun_filter(run, (), failed=True))
    # The restored file has another time, so the recorded failure is of another graph: the tile is pending.
    fixed = fixed or results_of(run, executor)
    assert computed(fixed) == times(1)
    assert summary(run).failed == 0


def test_rerun_filter_selects_given_or_failed_tiles(run, executor):
    broken, _ = truncate(run, 0)
    run_tiles(run, executor)
    assert [r.tile_id for r in results_of(run, executor, rerun_filter(run, (), failed=True))] == [broken]
    one = run.catalog.tiles[3].id
    results = results_of(run, executor, rerun_filter(run, (one,), failed=False))
    assert [(r.tile_id, r.status) for r in results] == [(one, "cached")]
    assert len(read_metrics(run.path)) == 12


def test_forced_stages_are_computed_again(finished, executor):
    one = finished.catalog.tiles[3].id
    force = frozenset({"fit", "sample", "evaluate"})
    results = results_of(finished, executor, rerun_filter(finished, (one,), failed=False), force)
    assert computed(results) == times(1, {"load": 1, "fit": 3, "sample": 3, "evaluate": 3, "export": 1})


def test_damaged_artefact_is_computed_again(finished, executor):
    before = read_metrics(finished.path)
    tile = finished.catalog.tiles[0].id
    for path in (finished.path / "store" / "evaluate").rglob("*.npz"):
        path.write_bytes(path.read_bytes()[:-40])
    for folder in (finished.path / "tiles").iterdir():
        (folder / "item.json").unlink()
    results = results_of(finished, executor)
    assert computed(results)["evaluate"] == 12
    assert computed(results)["ecsrc"] == 0
    after = read_metrics(finished.path)
    pd.testing.assert_frame_equal(before.drop(columns="seconds"), after.drop(columns="seconds"))
    assert finished.folder(tile).path.exists()


def test_tiles_of_an_older_version_are_exported_again_from_the_store(finished, executor, monkeypatch):
    monkeypatch.setattr("flexroad.tasks.products.cog.VERSION", 10**6)
    assert computed(results_of(finished, executor)) == times(4, {"export": 1})
    monkeypatch.setattr("flexroad.pipeline.graph.graph.ITEM_VERSION", 10**6)
    assert computed(results_of(Run.open(finished.path), executor)) == times(4, {"export": 1})


def test_missing_product_is_written_again(finished, executor):
    folder = finished.folder(finished.catalog.tiles[0].id).path
    (mesh,) = folder.glob("*.glb")
    whole = mesh.read_bytes()
    mesh.unlink()
    assert computed(results_of(finished, executor)) == times(1, {"export": 1})
    assert mesh.read_bytes() == whole


def test_full_disk_fails_tile_and_leaves_no_temporary_file(run, monkeypatch):
    put = ArtefactStore.put

    def full(self, node, value, *rest):
        if node.stage == "fit" and len(list(self.root.rglob("*.npz"))) > 12:
            raise OSError(28, "No space left on device", str(self.root))
        return put(self, node, value, *rest)

    monkeypatch.setattr(ArtefactStore, "put", full)
    results = results_of(run, SerialExecutor())
    failed = [r for r in results if r.status == "failed"]
    assert 0 < len(failed) < 4
    assert "No space left on device" in failed[0].failures[0].line
    monkeypatch.undo()
    assert {r.status for r in results_of(run, SerialExecutor())} == {"done", "cached"}
    assert not list(run.path.rglob("*.tmp"))


class CallBeforeTile(SerialExecutor):
    """Calls a function before the n-th tile is processed, after its graph was made."""

    def __init__(self, n, call):
        self.n, self.call = n, call

    def map(self, function, jobs, lost, probe=None):
        for i, job in enumerate(jobs):
            if i == self.n:
                self.call()
            yield function(job)


@pytest.mark.parametrize("change", ["replaced", "truncated"])
def test_source_changed_during_processing_fails_its_tile(change, run, survey, quick_config, tmp_path):
    tile = run.catalog.tiles[2]
    path = tile.paths(tile.layer("dsm"))[0]

    def change_source():
        if change == "truncated":
            path.write_bytes(path.read_bytes()[:700])
            return
        with rasterio.open(path, "r+") as raster:
            raster.write(raster.read(1) + 0.5, 1)

    whole = path.read_bytes()
    results = results_of(run, CallBeforeTile(2, change_source))
    assert [result.status for result in results] == ["done", "done", "failed", "done"]
    (failure,) = results[2].failures
    assert (failure.stage, failure.kind, failure.file) == ("load", "SourceChanged", str(path))
    assert "run the same command again" in failure.message
    assert not failure.trace
    stored = {path.stem for path in (run.path / "store").rglob("*.npz")}
    assert not stored & set(run.graph(tile).nodes)
    if change == "truncated":
        path.write_bytes(whole)
    counts = run_tiles(run, SerialExecutor())
    assert (counts.done, counts.cached, counts.changed) == (4, 3, 1)
    undisturbed = Run.create(tmp_path / "undisturbed", run.config, run.catalog)
    run_tiles(undisturbed, SerialExecutor())
    left, right = (read_metrics(r.path).drop(columns="seconds") for r in (run, undisturbed))
    pd.testing.assert_frame_equal(left, right, check_exact=True)


def assert_nothing_to_do(run) -> Summary:
    """Execute a finished run; fail if a tile is processed."""
    before = read_metrics(run.path)
    counts = run_tiles(run, CallBeforeTile(0, lambda: pytest.fail("a tile was processed")))
    assert (counts.done, counts.cached) == (4, 4)
    pd.testing.assert_frame_equal(before, read_metrics(run.path), check_exact=True)
    return counts


def test_resume_makes_each_graph_once_and_reads_no_marker(finished, monkeypatch):
    made = Counter()
    graph = Pattern.graph

    def counted(self, tile, *arguments):
        made[tile.id] += 1
        return graph(self, tile, *arguments)

    monkeypatch.setattr(Pattern, "graph", counted)
    monkeypatch.setattr(
        "flexroad.pipeline.run.status._from_marker", lambda *_: pytest.fail("a marker was read")
    )
    assert_nothing_to_do(Run.open(finished.path))
    assert made == {tile.id: 1 for tile in finished.catalog.tiles}


@pytest.mark.parametrize("state", ["lost", "damaged", "outdated"])
def test_outdated_database_is_restored_from_markers(state, finished):
    database = finished.path / "database.txt"
    before = database.read_bytes()
    run = changed(finished, evaluate={"nearest": True})
    run_tiles(run, SerialExecutor())
    if state == "lost":
        database.unlink()
    else:
        # As if the client had been killed before it wrote any record.
        database.write_bytes(before if state == "outdated" else before[:5000])
    assert summary(run).done == 4
    assert_nothing_to_do(run)
    assert read_metrics(run.path).nearest_road_m.notna().all()


def test_summary_counts_new_changed_and_vanished_tiles(run):
    first = Run.create(run.path, run.config, Catalog(run.catalog.tiles[:3]))
    counts = run_tiles(first, SerialExecutor())
    assert (counts.new, counts.changed, counts.vanished, counts.exit_code) == (3, 0, 0, 0)
    tile = run.catalog.tiles[1]
    os.utime(tile.paths(tile.layer("dtm"))[0], (1, 1))
    second = Run.create(run.path, run.config, Catalog(run.catalog.tiles[1:]))
    assert [summary(second).pending, summary(second).done] == [2, 1]
    counts = run_tiles(second, SerialExecutor())
    assert (counts.new, counts.changed, counts.vanished) == (1, 1, 1)
    assert (counts.tiles, counts.done, counts.cached) == (3, 3, 1)
    written = json.loads((run.path / "summary.json").read_text())
    assert {name: written[name] for name in ("new", "changed", "vanished", "done", "exit_code")} == {
        "new": 1, "changed": 1, "vanished": 1, "done": 3, "exit_code": 0,
    }  # fmt: skip
    assert written["start"] < written["end"]
    assert list(read_metrics(run.path).tile_id.unique()) == [tile.id for tile in second.catalog.tiles]
    assert run_tiles(second, SerialExecutor()).vanished == 0


def test_interrupted_run_writes_tables_and_summary(run):
    def interrupt():
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_tiles(run, CallBeforeTile(2, interrupt))
    written = json.loads((run.path / "summary.json").read_text())
    assert {name: written[name] for name in ("interrupted", "exit_code", "done", "pending")} == {
        "interrupted": True, "exit_code": 130, "done": 2, "pending": 2,
    }  # fmt: skip
    assert read_metrics(run.path).tile_id.nunique() == 2
    counts = run_tiles(run, SerialExecutor())
    assert (counts.done, counts.cached, counts.interrupted, counts.exit_code) == (4, 2, False, 0)


def test_interrupted_run_drops_rows_of_earlier_configuration(finished):
    def interrupt():
        raise KeyboardInterrupt

    other = changed(finished, evaluate={"nearest": True})
    with pytest.raises(KeyboardInterrupt):
        run_tiles(other, CallBeforeTile(1, interrupt))
    rows = read_metrics(finished.path)
    assert list(rows.tile_id.unique()) == [finished.catalog.tiles[0].id]
    assert rows.nearest_road_m.notna().all()


def test_verify_writes_changed_product_again(finished):
    folder = finished.folder(finished.catalog.tiles[0].id).path
    (mesh,) = folder.glob("*.glb")
    whole = mesh.read_bytes()
    mesh.write_bytes(bytes(len(whole)))
    assert_nothing_to_do(finished)
    results = []
    run_tiles(finished, SerialExecutor(), watch=results.append, verify=True)
    assert computed(results) == times(1, {"export": 1})
    assert mesh.read_bytes() == whole


def test_missing_source_keeps_result_until_tile_is_processed(finished):
    tile = finished.catalog.tiles[1]
    tile.paths(tile.layer("dsm"))[0].unlink()
    assert (summary(finished).done, summary(finished).pending) == (4, 0)
    other = finished.catalog.tiles[0].id
    counts = run_tiles(finished, SerialExecutor(), rerun_filter(finished, (other,), failed=False))
    assert (counts.done, counts.cached, counts.failed) == (4, 1, 0)
    counts = run_tiles(finished, SerialExecutor())
    assert (counts.done, counts.cached, counts.failed) == (3, 3, 1)
    assert counts.failures[0].tile_id == tile.id


def test_log_has_one_event_per_tile_and_stage(run, executor):
    run_tiles(run, executor)
    events = [json.loads(line) for line in (run.path / "log.jsonl").read_text().splitlines()]
    kinds = Counter(event["event"] for event in events)
    assert kinds == {"run": 1, "stage": 4 * len(EACH), "tile": 4, "end": 1}
    stages = [event for event in events if event["event"] == "stage"]
    for tile in run.catalog.tiles:
        by_stage = {event["stage"]: event for event in stages if event["tile"] == tile.id}
        assert {stage: event["computed"] for stage, event in by_stage.items()} == EACH
        assert by_stage["fit"]["bytes"] > 1000
        assert by_stage["load"]["bytes"] == 0
    assert all(event["peak_mb"] > 10 and event["pid"] and event["host"] for event in stages)


def test_item_is_valid_stac_with_checksums(run, executor):
    import hashlib

    import pystac

    run_tiles(run, executor)
    tile = run.catalog.tiles[0]
    folder = run.folder(tile.id).path
    item = pystac.Item.from_file(str(folder / "item.json"))
    assert item.id == tile.id
    assert set(item.assets) == {"mesh", "ply", "height", "road", "height_source", "surface"}
    assert {path.name for path in folder.iterdir()} == {
        *(asset.href for asset in item.assets.values()),
        "item.json",
    }
    for asset in item.assets.values():
        data = (folder / asset.href).read_bytes()
        assert asset.extra_fields["file:checksum"] == "1220" + hashlib.sha256(data).hexdigest()


def test_products_open_in_standard_readers(run, executor):
    import trimesh

    run_tiles(run, executor)
    tile = run.catalog.tiles[0]
    folder = run.folder(tile.id).path
    scene = trimesh.load(folder / f"{tile.id}_flexroad.glb")
    assert set(scene.geometry) == {"road", "terrain"}
    cloud = trimesh.load(folder / f"{tile.id}_flexroad.ply", process=False)
    west, south, east, north = tile.grid.hull
    assert np.allclose(cloud.bounds[:, :2], [[west, south], [east, north]], atol=1e-6)
    with rasterio.open(folder / f"{tile.id}_flexroad_height.tif") as raster:
        assert tuple(raster.bounds) == tile.grid.bounds
        assert raster.crs.to_epsg() == 25832


def test_edge_steps_of_large_run_are_a_sample(finished, monkeypatch):
    results = gather(finished).results
    check, whole, note = edge_steps(finished, results)
    assert (len(whole), note) == (4, "")
    assert list(check.result) == ["tiles are fitted independently"]
    monkeypatch.setattr(steps, "MOST", 2)
    _, part, note = edge_steps(finished, results)
    pairs = ["tile", "neighbour"]
    assert 0 < len(part) < len(whole)
    chosen = pd.MultiIndex.from_frame(part[pairs])
    assert part.set_index(pairs).equals(whole.set_index(pairs).loc[chosen])
    assert note == "Of one tile in 2, against its neighbours in the east and north."


def test_report_checks_every_tile_once(finished, monkeypatch):
    graph, checked = Pattern.graph, Counter()

    def counted(pattern, tile, *arguments):
        checked[tile.id] += 1
        return graph(pattern, tile, *arguments)

    monkeypatch.setattr(Pattern, "graph", counted)
    content = gather(finished)
    assert len(content.tables[LARGEST_STEPS][0]) == 4
    picture = relief(finished, finished.catalog.tiles, content.results)
    assert list(picture.places) == [tile.id for tile in finished.catalog.tiles]
    assert checked == dict.fromkeys(picture.places, 1)


def test_relief_has_tiles_with_results_in_the_store(finished):
    first, second, *others = finished.catalog.tiles
    stored = gather(finished).results["flexroad"]
    results = {"flexroad": {tile.id: stored[tile.id] for tile in (first, second)}}
    (surface,) = finished.store.glob(f"fit/*/{results['flexroad'][first.id][0]}.npz")
    surface.unlink()
    assert list(relief(finished, finished.catalog.tiles, results).places) == [second.id]
    assert relief(finished, others, results) is None


def test_run_with_pipe_as_log_does_not_wait_for_a_reader(run):
    (run.path / "log.jsonl").unlink(missing_ok=True)
    os.mkfifo(run.path / "log.jsonl")
    assert run_tiles(run, SerialExecutor()).done == len(run.catalog.tiles)
    assert (run.path / "log.jsonl").is_fifo()


def test_open_folder_without_run_raises(tmp_path):
    with pytest.raises(ConfigError, match="is no run"):
        Run.open(tmp_path)
