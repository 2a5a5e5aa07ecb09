"""The lock of a run: one at a time, named; a dead holder's is taken over, a living one's never."""

import json
import os
import signal
import subprocess
import sys
import threading
import time
from dataclasses import replace

import pytest

from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.run.lock import Heartbeat, Owner, at_work, owner, run_lock, started

HOLD = """
import sys, time
from pathlib import Path
from flexroad.pipeline.run.lock import run_lock
with run_lock(Path(sys.argv[1])):
    print("held", flush=True)
    time.sleep(600)
"""
QUICK = Heartbeat(beat_s=0.05, stale_s=0.5)
ELSEWHERE = Owner("node7", "m7 pid:[1]", "b7", 4711, 99, "2026-11-20T02:00:00+00:00", "t7")


@pytest.fixture
def process(tmp_path):
    """Another process that holds the lock of ``tmp_path``."""
    with subprocess.Popen([sys.executable, "-c", HOLD, tmp_path], stdout=subprocess.PIPE, text=True) as other:
        assert other.stdout.readline() == "held\n"
        yield other
        other.kill()


def written(folder, who: Owner, age_s: float = 0.0) -> None:
    (folder / "lock.json").write_bytes(who.data)
    then = time.time() - age_s
    os.utime(folder / "lock.json", (then, then))


def taken(folder, pace: Heartbeat = QUICK) -> list[str]:
    """Take the lock and give it back; return what was said."""
    said: list[str] = []
    with run_lock(folder, said.append, pace):
        assert owner(folder).pid == os.getpid()
    assert not (folder / "lock.json").exists()
    return said


def test_a_second_holder_is_refused_by_host_and_pid(process, tmp_path):
    me = Owner.me()
    with pytest.raises(ConfigError, match=rf"pid {process.pid} on {me.host} since .* `kill {process.pid}`"):
        taken(tmp_path)
    assert owner(tmp_path).pid == process.pid


def test_of_a_killed_holder_it_is_taken_over_at_once_and_said_in_one_line(process, tmp_path):
    assert "at work since" in at_work(owner(tmp_path))
    process.send_signal(signal.SIGKILL)
    # Not waited for: a dead process that nobody buried still has its number.
    while started(process.pid) is not None:
        time.sleep(0.01)
    assert "ended in the middle (that process is gone)" in at_work(owner(tmp_path))
    assert taken(tmp_path) == [
        f"took over the lock of pid {process.pid} on {Owner.me().host}: that process is gone"
    ]


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({"start": 1}, "its number was given to another"),
        ({"boot": "before"}, "was restarted since"),
        ({"pid": 2**22 + 1}, "that process is gone"),
    ],
)
def test_a_holder_of_this_machine_is_judged_by_the_process_table(change, why, tmp_path):
    # A heartbeat in the future, as after a clock set back, or a fresh one: neither counts.
    written(tmp_path, replace(Owner.me(), **change), age_s=-3600)
    (said,) = taken(tmp_path)
    assert why in said
    written(tmp_path, Owner.me(), age_s=86400)
    with pytest.raises(ConfigError, match="is in use by pid"):
        taken(tmp_path)


def test_a_container_that_counts_processes_for_itself_is_another_machine(tmp_path):
    written(tmp_path, replace(Owner.me(), machine="m pid:[2]", pid=2**22 + 1))
    with pytest.raises(ConfigError, match="last sign of life 0 s ago"):
        taken(tmp_path)


def test_of_another_machine_the_heartbeat_tells(tmp_path):
    written(tmp_path, ELSEWHERE, age_s=0.1)
    with pytest.raises(ConfigError, match="pid 4711 on node7 since 2026-11-20.* the same command takes over"):
        taken(tmp_path)
    written(tmp_path, ELSEWHERE, age_s=400)
    watching, said = taken(tmp_path)
    assert watching.startswith("watching the lock of pid 4711 on node7")
    assert said == "took over the lock of pid 4711 on node7: no sign of life for 400 s"


@pytest.mark.parametrize("age_s", [3600, -3600], ids=["set forward", "set back"])
def test_a_clock_that_jumped_kills_no_living_holder(age_s, tmp_path):
    written(tmp_path, ELSEWHERE, age_s)
    over = threading.Event()

    def beat() -> None:
        while not over.wait(0.05):
            os.utime(tmp_path / "lock.json")

    alive = threading.Thread(target=beat)
    alive.start()
    try:
        with pytest.raises(ConfigError, match="pid 4711 on node7"):
            taken(tmp_path, Heartbeat(beat_s=1, stale_s=300))
    finally:
        over.set()
        alive.join()


def test_a_clock_set_back_keeps_no_dead_holder(tmp_path):
    written(tmp_path, ELSEWHERE, age_s=-86400)
    assert "took over" in taken(tmp_path)[-1]


def test_a_damaged_lock_is_refused_while_young_and_then_taken_over(tmp_path):
    (tmp_path / "lock.json").write_text('{"host": "no')
    with pytest.raises(ConfigError, match="somebody unknown"):
        taken(tmp_path)
    os.utime(tmp_path / "lock.json", (1, 1))
    assert "took over" in taken(tmp_path)[-1]


@pytest.mark.parametrize("stale", [False, True])
def test_of_many_that_race_exactly_one_wins(stale, tmp_path):
    code = (
        "import sys, time\nfrom pathlib import Path\nfrom flexroad.pipeline.run.lock import run_lock\n"
        "print('ready', flush=True); sys.stdin.readline()\n"
        "with run_lock(Path(sys.argv[1])):\n    print('won', flush=True); sys.stdin.readline()"
    )
    many = [
        subprocess.Popen(
            [sys.executable, "-c", code, tmp_path],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        )
        for _ in range(3)
    ]  # fmt: skip
    assert [one.stdout.readline() for one in many] == ["ready\n"] * 3
    if stale:
        written(tmp_path, replace(Owner.me(), pid=2**22 + 1))
    for one in many:
        one.stdin.write("go\n")
        one.stdin.flush()
    winners = [one for one in many if one.stdout.readline() == "won\n"]
    assert len(winners) == 1
    assert owner(tmp_path).pid == winners[0].pid
    for one in many:
        _, error = one.communicate("end\n")
        assert one in winners or f"is in use by pid {winners[0].pid} on" in error
    assert not (tmp_path / "lock.json").exists()


def test_a_living_holder_gives_signs_of_life_and_mends_a_lock_removed_by_hand(tmp_path):
    with run_lock(tmp_path, pace=QUICK):
        os.utime(tmp_path / "lock.json", (1, 1))
        _until(lambda: (tmp_path / "lock.json").stat().st_mtime > 1)
        (tmp_path / "lock.json").unlink()
        _until(lambda: owner(tmp_path) is not None)
        assert owner(tmp_path).pid == os.getpid()


def test_who_lost_the_lock_ends_and_leaves_it_to_the_other(tmp_path):
    said: list[str] = []

    def lose() -> None:
        with run_lock(tmp_path, said.append, QUICK):
            written(tmp_path, ELSEWHERE)
            _until(lambda: bool(said), 10)
            time.sleep(30)

    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        with pytest.raises(KeyboardInterrupt):
            lose()
    finally:
        signal.signal(signal.SIGTERM, before)
    assert "pid 4711 on node7 took over" in said[0]
    assert json.loads((tmp_path / "lock.json").read_text())["token"] == "t7"


def test_what_cannot_be_locked_is_said(tmp_path):
    with pytest.raises(ConfigError, match="is no run"):
        taken(tmp_path / "nowhere")
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match="cannot write the run"):
        taken(tmp_path / "file")


def _until(true, seconds: float = 30) -> None:
    end = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < end
        time.sleep(0.01)
