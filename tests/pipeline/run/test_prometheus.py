"""Text file for Prometheus, read by Prometheus' own parser."""

import pytest
from prometheus_client.parser import text_string_to_metric_families

from flexroad.pipeline.run.prometheus import Textfile
from flexroad.pipeline.run.summary import Summary
from flexroad.pipeline.store.records import TileRecord
from flexroad.pipeline.worker.evaluator import StageCost
from flexroad.pipeline.worker.tile import TileResult


def result(status, **spans) -> TileResult:
    return TileResult(TileRecord("t", "done", "f", ()), status, spans)


def read(path) -> dict[tuple[str, str], float]:
    """Values by name and the label other than ``run``."""
    values = {}
    for family in text_string_to_metric_families(path.read_text()):
        assert family.documentation
        for sample in family.samples:
            labels = dict(sample.labels)
            assert labels.pop("run") == 'a "run"\\'
            values[sample.name, "".join(labels.values())] = sample.value
    return values


def tiles(values) -> dict[str, float]:
    return {state: value for (name, state), value in values.items() if name == "flexroad_tiles"}


def test_textfile_shows_states_during_and_after_run(tmp_path):
    path = tmp_path / "run.prom"
    with Textfile(path, 'a "run"\\') as textfile:
        assert read(path)["flexroad_run_running", ""] == 1
        textfile.total = 5
        textfile(result("cached"))
        textfile(
            result(
                "done",
                fit=StageCost(seconds=2, peak_mb=100, computed=1),
                load=StageCost(seconds=1, computed=1),
            )
        )
        textfile(result("failed", fit=StageCost(seconds=1, peak_mb=50, computed=1)))
        textfile.write()
        running = read(path)
        assert tiles(running) == {"done": 1, "cached": 1, "failed": 1, "pending": 2}
        assert running["flexroad_stage_seconds", "fit"] == 3
        assert running["flexroad_worker_peak_bytes", ""] == 100 * 2**20
        assert ("flexroad_run_exit_code", "") not in running
        assert running["flexroad_tiles_without_roads", ""] == 0
        textfile.ended(1, Summary(7, 5, 1, 3, 1, without_roads=2))
    ended = read(path)
    assert ended["flexroad_run_running", ""] == 0
    assert ended["flexroad_run_exit_code", ""] == 1
    assert ended["flexroad_run_end_time_seconds", ""] >= ended["flexroad_run_start_time_seconds", ""]
    assert tiles(ended) == {"done": 2, "cached": 3, "failed": 1, "pending": 1}
    assert ended["flexroad_tiles_without_roads", ""] == 2
    assert [file.name for file in tmp_path.iterdir()] == ["run.prom"]


def test_textfile_between_tiles_is_written_by_thread(tmp_path):
    import time

    path = tmp_path / "run.prom"
    with Textfile(path, 'a "run"\\', every_s=0.01) as textfile:
        textfile(result("done"))
        while read(path)["flexroad_tiles", "done"] != 1:
            time.sleep(0.01)


def test_textfile_in_missing_folder_raises(tmp_path):
    with pytest.raises(OSError, match="nowhere"), Textfile(tmp_path / "nowhere" / "run.prom", "r"):
        pass
