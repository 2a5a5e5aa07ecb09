"""The event log after a fault."""

import json

import pytest

from flexroad.pipeline.run.events import EventLog


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
