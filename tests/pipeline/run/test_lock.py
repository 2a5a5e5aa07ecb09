"""The lock of a run: one owner at a time; a dead owner's lock is taken over, a living one's never."""

import errno
import json
import os
import signal
import subprocess
import sys
import threading
import time
from dataclasses import replace

import pytest

from flexroad.catalog.storage.paths import parse_location, write
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.run import lock
from flexroad.pipeline.run.lock import Owner, describe_owner, owner, run_lock, started
from flexroad.pipeline.run.lock_file import InBucket
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


def take_lock(folder, times: dict[str, float] = QUICK) -> list[str]:
    """Take and release the lock; return its messages."""
    messages: list[str] = []
    with run_lock(folder, messages.append, **times):
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


ME = Owner.me()
GONE = {"pid": 2**22 + 1}
UPTIME_S, LONG_AGO_S = lock._uptime_s(), 86400.0
OTHER_BOOT = replace(ME, boot="other", **GONE)
REFUSED = {
    "the process lives": (ME, LONG_AGO_S, QUICK, UPTIME_S, "is in use by pid"),
    "same image, this one started long ago": (OTHER_BOOT, 20, {}, LONG_AGO_S, "life 20 s ago; if it is dead"),
    "same image, this one started just now": (OTHER_BOOT, 20, {}, 5.0, "life 20 s ago; if it is dead"),
    "another container": (
        replace(ME, machine="m pid:[2]", **GONE),
        0,
        QUICK,
        UPTIME_S,
        "last sign of life 0 s",
    ),
    "another machine": (ELSEWHERE, 0.1, QUICK, UPTIME_S, "pid 4711 on node7 .* the same command takes over"),
}
TAKEN_OVER = {
    # The time of the lock is in the future, as after a clock set back.
    "number of another": (replace(ME, start=1), -3600, QUICK, UPTIME_S, "its number was given to another"),
    "process gone": (replace(ME, **GONE), -3600, QUICK, UPTIME_S, "that process is gone"),
    "clock set back": (ELSEWHERE, -LONG_AGO_S, QUICK, UPTIME_S, "no sign of life for"),
    "restarted": (replace(ME, boot="before"), UPTIME_S + 100, {"stale_s": 1e9}, UPTIME_S, "was restarted"),
    "same image": (replace(ME, boot="other"), 400, QUICK, LONG_AGO_S, "no sign of life for 400 s"),
    "another machine": (ELSEWHERE, 400, QUICK, UPTIME_S, "pid 4711 on node7: no sign of life for 400 s"),
}
"""Owner, age of the lock (s), times of renewal, uptime of this machine (s), and part of the message.

A machine of the same image has the name of this one. The process table decides if it can, not the age.
"""


@pytest.mark.parametrize("name", REFUSED)
def test_lock_of_an_owner_that_may_be_alive_is_refused(name, tmp_path, monkeypatch):
    holder, age_s, times, uptime_s, message = REFUSED[name]
    monkeypatch.setattr(lock, "_uptime_s", lambda: uptime_s)
    write_lock(tmp_path, holder, age_s)
    with pytest.raises(ConfigError, match=message):
        take_lock(tmp_path, times)


@pytest.mark.parametrize("name", TAKEN_OVER)
def test_lock_of_a_dead_owner_is_taken_over(name, tmp_path, monkeypatch):
    holder, age_s, times, uptime_s, reason = TAKEN_OVER[name]
    monkeypatch.setattr(lock, "_uptime_s", lambda: uptime_s)
    write_lock(tmp_path, holder, age_s)
    *watching, taken_over = take_lock(tmp_path, times)
    assert taken_over.startswith("took over the lock of")
    assert reason in taken_over
    # Only an owner that the process table does not know is watched for a while.
    assert bool(watching) == ("no sign of life" in reason)
    assert all(line.startswith("watching the lock of") for line in watching)


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
            take_lock(tmp_path, {"interval_s": 1, "stale_s": 300})
    finally:
        stop.set()
        renewal.join()


def test_damaged_lock_is_taken_over_when_stale(tmp_path):
    (tmp_path / "lock.json").write_text('{"host": "no')
    with pytest.raises(ConfigError, match="an unknown process"):
        take_lock(tmp_path)
    os.utime(tmp_path / "lock.json", (1, 1))
    assert "took over" in take_lock(tmp_path)[-1]


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


def test_lock_on_full_disk_is_released(monkeypatch, tmp_path):
    def full(**_):
        raise OSError(errno.ENOSPC, "No space left on device")

    with run_lock(tmp_path):
        monkeypatch.setattr("tempfile.TemporaryFile", full)
    assert not list(tmp_path.iterdir())


def _until(condition, seconds: float = 30) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.01)


# --- object storage -----------------------------------------------------------------------------------


@pytest.fixture
def run(bucket):
    return bucket / "run"


IN_BUCKET = (pytest.mark.slow, pytest.mark.soak("runs"))


def in_bucket(test):
    return IN_BUCKET[0](IN_BUCKET[1](test))


@in_bucket
def test_lock_in_bucket_is_exclusive_renewed_and_released(run):
    with run_lock(run, **QUICK):
        assert owner(run).token != ELSEWHERE.token
        with pytest.raises(ConfigError, match="is in use by pid"), run_lock(run):
            pass
        modified = lambda: run.fs.info((run / "lock.json").path)["LastModified"]  # noqa: E731
        first = modified()
        _until(lambda: modified() != first)
    assert owner(run) is None
    with run_lock(run):
        pass


@in_bucket
def test_lock_in_bucket_of_dead_owner_is_taken_over(run):
    messages: list[str] = []
    write(run / "lock.json", replace(ME, **GONE).data)
    with run_lock(run, messages.append):
        assert owner(run).pid == ME.pid
    assert "that process is gone" in messages[0]
    write(run / "lock.json", ELSEWHERE.data)
    with pytest.raises(ConfigError, match="the same command takes over"):
        run_lock(run, stale_s=60).__enter__()
    # Times of a bucket's objects are whole seconds.
    time.sleep(1.1)
    with run_lock(run, messages.append, **QUICK):
        assert owner(run).token != "t7"
    assert messages[-1].startswith("took over the lock of pid 4711 on node7: no sign of life")


@pytest.mark.parametrize("place", ["tmp_path", pytest.param("run", marks=IN_BUCKET)])
@pytest.mark.parametrize("stale", [False, True])
def test_lock_requested_by_many_is_taken_by_one(stale, place, request):
    run = request.getfixturevalue(place)
    if stale:
        write(run / "lock.json", replace(ME, **GONE).data)
    start, tried, outcomes = threading.Barrier(4), threading.Semaphore(0), []

    def race() -> None:
        start.wait()
        try:
            with run_lock(run):
                outcomes.append("won")
                # Hold the lock until the other three have been refused.
                for _ in range(3):
                    tried.acquire()
        except ConfigError as error:
            outcomes.append(str(error))
            tried.release()

    racers = [threading.Thread(target=race, daemon=True) for _ in range(4)]
    for racer in racers:
        racer.start()
    for racer in racers:
        racer.join(60)
    assert len(outcomes) == 4
    assert outcomes.count("won") == 1
    assert sum("is in use by pid" in outcome for outcome in outcomes) == 3


@in_bucket
def test_create_in_bucket_with_lost_response_takes_lock(run, monkeypatch):
    """The lock was created but the response was lost; the repeated request is rejected."""
    create = InBucket.create
    monkeypatch.setattr(InBucket, "create", lambda self, data: create(self, data) and create(self, data))
    with run_lock(run):
        assert owner(run).pid == ME.pid


@in_bucket
def test_lock_in_missing_bucket_names_run_and_reason(run):
    nowhere = parse_location("s3://nowhere/run")
    with pytest.raises(ConfigError, match=r"cannot write the run to s3://nowhere/run: .*no such bucket"):
        run_lock(nowhere).__enter__()
