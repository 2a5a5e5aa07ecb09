"""The lock of a run: one owner at a time; a dead owner's lock is taken over, a living one's never."""

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
from flexroad.pipeline.run import lock
from flexroad.pipeline.run.lock import Owner, describe_owner, owner, run_lock, started
from tests.faulty_files import intercepted
from tests.power_loss import Recording, states

HOLD = """
import sys, time
from pathlib import Path
from flexroad.pipeline.run.lock import run_lock
with run_lock(Path(sys.argv[1])):
    print("held", flush=True)
    time.sleep(600)
"""
QUICK = {"interval_s": 0.05, "stale_s": 0.5}
ELSEWHERE = Owner("node7", "m7 pid:[1]", "b7", 4711, 99, "2026-11-20T02:00:00+00:00", "t7")


@pytest.fixture
def process(tmp_path):
    """Another process that holds the lock of ``tmp_path``."""
    with subprocess.Popen([sys.executable, "-c", HOLD, tmp_path], stdout=subprocess.PIPE, text=True) as other:
        assert other.stdout.readline() == "held\n"
        yield other
        other.kill()


def write_lock(folder, holder: Owner, age_s: float = 0.0) -> None:
    (folder / "lock.json").write_bytes(holder.data)
    modified = time.time() - age_s
    os.utime(folder / "lock.json", (modified, modified))


def take_lock(folder, interval_s: float = 0.05, stale_s: float = 0.5) -> list[str]:
    """Take and release the lock; return its messages."""
    messages: list[str] = []
    with run_lock(folder, messages.append, interval_s, stale_s):
        assert owner(folder).pid == os.getpid()
    assert not (folder / "lock.json").exists()
    return messages


def test_lock_after_power_failure_names_its_owner_or_is_missing(tmp_path):
    recording = Recording(tmp_path)
    with intercepted(tmp_path, recording), run_lock(tmp_path):
        end, whole = len(recording.operations), (tmp_path / "lock.json").read_bytes()
    found = {state.get(tmp_path / "lock.json", (None,))[0] for state in states(recording, 100, end)}
    assert found == {whole, None}


def test_lock_held_by_living_process_is_refused(process, tmp_path):
    me = Owner.me()
    with pytest.raises(ConfigError, match=rf"pid {process.pid} on {me.host} since .* `kill {process.pid}`"):
        take_lock(tmp_path)
    assert owner(tmp_path).pid == process.pid


def test_lock_of_killed_process_is_taken_over_at_once(process, tmp_path):
    assert "at work since" in describe_owner(owner(tmp_path))
    process.send_signal(signal.SIGKILL)
    # The process is not waited for: as a zombie it still has its pid.
    while started(process.pid) is not None:
        time.sleep(0.01)
    assert "ended before the run was complete (that process is gone)" in describe_owner(owner(tmp_path))
    assert take_lock(tmp_path) == [
        f"took over the lock of pid {process.pid} on {Owner.me().host}: that process is gone"
    ]


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"start": 1}, "its number was given to another"),
        ({"pid": 2**22 + 1}, "that process is gone"),
    ],
)
def test_owner_on_this_machine_is_checked_by_process_table(change, reason, tmp_path):
    # The age of the lock is ignored, even if it is in the future, as after a clock set back.
    write_lock(tmp_path, replace(Owner.me(), **change), age_s=-3600)
    (message,) = take_lock(tmp_path)
    assert reason in message
    write_lock(tmp_path, Owner.me(), age_s=86400)
    with pytest.raises(ConfigError, match="is in use by pid"):
        take_lock(tmp_path)


def test_owner_before_the_last_start_of_this_machine_is_dead_at_once(tmp_path):
    write_lock(tmp_path, replace(Owner.me(), boot="before"), age_s=lock._uptime_s() + 100)
    (message,) = take_lock(tmp_path, interval_s=30, stale_s=1e9)
    assert "was restarted since" in message


@pytest.mark.parametrize("uptime_s", [86400.0, 5.0], ids=["long ago", "just now"])
def test_owner_with_other_boot_that_renewed_its_lock_is_other_machine(uptime_s, tmp_path, monkeypatch):
    """As of another machine made of the same image; this one was started long ago, or just now."""
    monkeypatch.setattr(lock, "_uptime_s", lambda: uptime_s)
    write_lock(tmp_path, replace(Owner.me(), boot="other", pid=2**22 + 1), age_s=20)
    with pytest.raises(ConfigError, match="last sign of life 20 s ago; if it is dead, the same command"):
        take_lock(tmp_path, interval_s=30, stale_s=300)


def test_owner_with_other_boot_is_taken_over_when_stale(tmp_path, monkeypatch):
    monkeypatch.setattr(lock, "_uptime_s", lambda: 86400.0)
    write_lock(tmp_path, replace(Owner.me(), boot="other"), age_s=400)
    watching, taken_over = take_lock(tmp_path)
    assert watching.startswith("watching the lock of")
    assert "no sign of life for 400 s" in taken_over


def test_owner_in_other_pid_namespace_is_other_machine(tmp_path):
    write_lock(tmp_path, replace(Owner.me(), machine="m pid:[2]", pid=2**22 + 1))
    with pytest.raises(ConfigError, match="last sign of life 0 s ago"):
        take_lock(tmp_path)


def test_owner_on_other_machine_is_checked_by_lock_age(tmp_path):
    write_lock(tmp_path, ELSEWHERE, age_s=0.1)
    with pytest.raises(ConfigError, match="pid 4711 on node7 since 2026-11-20.* the same command takes over"):
        take_lock(tmp_path)
    write_lock(tmp_path, ELSEWHERE, age_s=400)
    watching, taken_over = take_lock(tmp_path)
    assert watching.startswith("watching the lock of pid 4711 on node7")
    assert taken_over == "took over the lock of pid 4711 on node7: no sign of life for 400 s"


@pytest.mark.parametrize("age_s", [3600, -3600], ids=["set forward", "set back"])
def test_clock_jump_keeps_lock_of_living_owner(age_s, tmp_path):
    write_lock(tmp_path, ELSEWHERE, age_s)
    stop = threading.Event()

    def renew() -> None:
        while not stop.wait(0.05):
            os.utime(tmp_path / "lock.json")

    renewal = threading.Thread(target=renew)
    renewal.start()
    try:
        with pytest.raises(ConfigError, match="pid 4711 on node7"):
            take_lock(tmp_path, interval_s=1, stale_s=300)
    finally:
        stop.set()
        renewal.join()


def test_clock_set_back_lock_of_dead_owner_is_taken_over(tmp_path):
    write_lock(tmp_path, ELSEWHERE, age_s=-86400)
    assert "took over" in take_lock(tmp_path)[-1]


def test_damaged_lock_is_taken_over_when_stale(tmp_path):
    (tmp_path / "lock.json").write_text('{"host": "no')
    with pytest.raises(ConfigError, match="an unknown process"):
        take_lock(tmp_path)
    os.utime(tmp_path / "lock.json", (1, 1))
    assert "took over" in take_lock(tmp_path)[-1]


@pytest.mark.parametrize("stale", [False, True])
def test_lock_requested_by_many_is_taken_by_one(stale, tmp_path):
    code = (
        "import sys, time\nfrom pathlib import Path\nfrom flexroad.pipeline.run.lock import run_lock\n"
        "print('ready', flush=True); sys.stdin.readline()\n"
        "with run_lock(Path(sys.argv[1])):\n    print('won', flush=True); sys.stdin.readline()"
    )
    processes = [
        subprocess.Popen(
            [sys.executable, "-c", code, tmp_path],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        )
        for _ in range(3)
    ]  # fmt: skip
    assert [process.stdout.readline() for process in processes] == ["ready\n"] * 3
    if stale:
        write_lock(tmp_path, replace(Owner.me(), pid=2**22 + 1))
    for process in processes:
        process.stdin.write("go\n")
        process.stdin.flush()
    winners = [process for process in processes if process.stdout.readline() == "won\n"]
    assert len(winners) == 1
    assert owner(tmp_path).pid == winners[0].pid
    for process in processes:
        _, error = process.communicate("end\n")
        assert process in winners or f"is in use by pid {winners[0].pid} on" in error
    assert not (tmp_path / "lock.json").exists()


def test_held_lock_is_renewed_and_restored_after_deletion(tmp_path):
    with run_lock(tmp_path, **QUICK):
        os.utime(tmp_path / "lock.json", (1, 1))
        _until(lambda: (tmp_path / "lock.json").stat().st_mtime > 1)
        (tmp_path / "lock.json").unlink()
        _until(lambda: owner(tmp_path) is not None)
        assert owner(tmp_path).pid == os.getpid()


def test_process_that_lost_its_lock_ends(tmp_path):
    messages: list[str] = []

    def lose() -> None:
        with run_lock(tmp_path, messages.append, **QUICK):
            write_lock(tmp_path, ELSEWHERE)
            _until(lambda: bool(messages), 10)
            time.sleep(30)

    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        with pytest.raises(KeyboardInterrupt):
            lose()
    finally:
        signal.signal(signal.SIGTERM, before)
    assert "pid 4711 on node7 took over" in messages[0]
    assert json.loads((tmp_path / "lock.json").read_text())["token"] == "t7"


def test_lock_in_unusable_folder_raises(tmp_path):
    with pytest.raises(ConfigError, match="is no run"):
        take_lock(tmp_path / "nowhere")
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match="cannot write the run"):
        take_lock(tmp_path / "file")


def _until(condition, seconds: float = 30) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.01)
