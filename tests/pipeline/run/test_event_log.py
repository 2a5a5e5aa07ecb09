"""The event log after a fault."""

import json

import pytest

from flexroad.pipeline.run.event_log import EventLog


@pytest.mark.parametrize("before", ["", '{"event": "end"}\n', '{"event": "e', "\0\0"])
def test_log_with_cut_off_line_gets_whole_lines(before, tmp_path):
    (tmp_path / "log.jsonl").write_text(before)
    with EventLog(tmp_path) as log:
        log.note("run")
    *_, last = (tmp_path / "log.jsonl").read_text().splitlines()
    assert json.loads(last)["event"] == "run"
    assert (tmp_path / "log.jsonl").read_text().startswith(before)
