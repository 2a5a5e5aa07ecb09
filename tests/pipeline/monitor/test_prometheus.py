"""The text file for Prometheus: read by its own parser, whole at any moment, right at the end."""

import pytest
from prometheus_client.parser import text_string_to_metric_families

from flexroad.pipeline.monitor.prometheus import Textfile
from flexroad.pipeline.run.summary import Summary
from flexroad.pipeline.store.records import TileRecord
from flexroad.pipeline.worker.profiling import StageCost
from flexroad.pipeline.worker.tile import TileResult


def result(status, **spans) -> TileResult:
    return TileResult(TileRecord("t", "done", "f", ()), status, spans)


def read(path) -> dict[tuple[str, str], float]:
    """Values by name and the label beside `run`; all of them are of the run."""
    found = {}
    for family in text_string_to_metric_families(path.read_text()):
        assert family.documentation
        for sample in family.samples:
            labels = dict(sample.labels)
            assert labels.pop("run") == 'a "run"\\'
            found[sample.name, "".join(labels.values())] = sample.value
    return found


def tiles(found) -> dict[str, float]:
    return {state: value for (name, state), value in found.items() if name == "flexroad_tiles"}


def test_it_tells_how_a_run_goes_and_how_it_ended(tmp_path):
    path = tmp_path / "run.prom"
    with Textfile(path, 'a "run"\\') as told:
        assert read(path)["flexroad_run_running", ""] == 1
        told.total = 5
        told(result("cached"))
        told(
            result(
                "done",
                fit=StageCost(seconds=2, peak_mb=100, computed=1),
                load=StageCost(seconds=1, computed=1),
            )
        )
        told(result("failed", fit=StageCost(seconds=1, peak_mb=50, computed=1)))
        told.write()
        going = read(path)
        assert tiles(going) == {"done": 1, "cached": 1, "failed": 1, "pending": 2}
        assert going["flexroad_stage_seconds", "fit"] == 3
        assert going["flexroad_worker_peak_bytes", ""] == 100 * 2**20
        assert ("flexroad_run_exit_code", "") not in going
        told.ended(1, Summary(7, 5, 1, 3, 1, 0, 0, 0, 1.0, ()))
    over = read(path)
    assert over["flexroad_run_running", ""] == 0
    assert over["flexroad_run_exit_code", ""] == 1
    assert over["flexroad_run_end_time_seconds", ""] >= over["flexroad_run_start_time_seconds", ""]
    assert tiles(over) == {"done": 2, "cached": 3, "failed": 1, "pending": 1}
    assert [file.name for file in tmp_path.iterdir()] == ["run.prom"]


def test_it_is_written_by_itself_while_tiles_take_long(tmp_path):
    import time

    path = tmp_path / "run.prom"
    with Textfile(path, 'a "run"\\', every_s=0.01) as told:
        told(result("done"))
        while read(path)["flexroad_tiles", "done"] != 1:
            time.sleep(0.01)


def test_a_folder_that_is_not_there_is_an_error_at_once(tmp_path):
    with pytest.raises(OSError, match="nowhere"), Textfile(tmp_path / "nowhere" / "run.prom", "r"):
        pass
