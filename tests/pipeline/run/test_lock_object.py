"""The lock of a run in object storage, tested with an S3 server."""

import threading
import time
from dataclasses import replace

import pytest

from flexroad.catalog.storage.paths import parse_location, read, write
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.run.lock import Owner, owner, run_lock

pytestmark = [pytest.mark.slow, pytest.mark.soak("runs")]

ELSEWHERE = Owner("node7", "m7 pid:[1]", "b7", 4711, 99, "2026-11-20T02:00:00+00:00", "t7")
QUICK = {"interval_s": 0.05, "stale_s": 0.5}


@pytest.fixture
def run(bucket):
    return bucket / "run"


def test_lock_is_exclusive_and_released(run):
    with run_lock(run):
        assert owner(run).token != ELSEWHERE.token
        with pytest.raises(ConfigError, match="is in use by pid"), run_lock(run):
            pass
    assert owner(run) is None
    with run_lock(run):
        pass


def test_lock_of_dead_process_is_taken_over_at_once(run):
    write(run / "lock.json", replace(Owner.me(), pid=2**22 + 1).data)
    messages = []
    with run_lock(run, messages.append):
        assert owner(run).pid == Owner.me().pid
    assert "that process is gone" in messages[0]


def test_owner_on_other_machine_is_checked_by_lock_age(run):
    write(run / "lock.json", ELSEWHERE.data)
    with (
        pytest.raises(ConfigError, match="the same command takes over"),
        run_lock(run, stale_s=60),
    ):
        pass
    messages = []
    # Times of a bucket's objects are whole seconds.
    time.sleep(1.1)
    with run_lock(run, messages.append, **QUICK):
        assert owner(run).token != "t7"
    assert messages[-1].startswith("took over the lock of pid 4711 on node7: no sign of life")


def test_held_lock_is_renewed(run):
    with run_lock(run, **QUICK):
        first = _time(run)
        while _time(run) == first:
            time.sleep(0.1)


@pytest.mark.parametrize("stale", [False, True])
def test_lock_requested_by_many_is_taken_by_one(stale, run):
    if stale:
        write(run / "lock.json", replace(Owner.me(), pid=2**22 + 1).data)
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


def test_create_with_lost_response_takes_lock(run, monkeypatch):
    """The lock was created but the response was lost; the repeated request is rejected."""
    from flexroad.pipeline.run.lock_file import InBucket

    create = InBucket.create
    monkeypatch.setattr(InBucket, "create", lambda self, data: create(self, data) and create(self, data))
    with run_lock(run):
        assert owner(run).pid == Owner.me().pid


def test_lock_in_missing_bucket_names_run(run):
    with pytest.raises(ConfigError, match="s3://nowhere/run"), run_lock(parse_location("s3://nowhere/run")):
        pass


def _time(run):
    assert Owner.of(read(run / "lock.json"))
    return run.fs.info((run / "lock.json").path)["LastModified"]


def test_lock_in_missing_bucket_names_reason(run):
    nowhere = parse_location("s3://nowhere/run")
    with (
        pytest.raises(ConfigError, match=r"cannot write the run to s3://nowhere/run: .*no such bucket"),
        run_lock(nowhere),
    ):
        pass
