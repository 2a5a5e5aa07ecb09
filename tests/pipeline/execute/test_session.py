"""Waiting for workers and leaving them out, with a client, workers and a clock of the test's own."""

import socket
from collections import Counter
from dataclasses import dataclass, field
from itertools import count
from types import SimpleNamespace

import pytest
from distributed.scheduler import KilledWorker

from flexroad.pipeline.errors import ClusterLost, ConfigError
from flexroad.pipeline.execute import session as module
from flexroad.pipeline.execute import workers
from flexroad.pipeline.execute.session import Session
from flexroad.pipeline.execute.workers import WorkerCheck


class Client:
    """A client of a scheduler that lists the workers of the test."""

    status = "running"

    def __init__(self):
        self.workers = {}

    def nthreads(self):
        return self.workers


@pytest.fixture
def session(monkeypatch):
    monkeypatch.setattr(module.time, "monotonic", lambda: session.now)
    session = Session(Client(), "", "", repr, iter([]), repr, 20, 3600, lambda line: None)
    session.now = 1000.0
    return session


def check_after(session, seconds, times=1):
    for _ in range(times):
        session.now += seconds
        session._check_cluster()


def test_check_without_workers_for_longer_than_the_patience_raises(session):
    check_after(session, 1, times=20)
    with pytest.raises(ClusterLost, match="for 20 s"):
        check_after(session, 1, times=3)


def test_check_after_a_suspension_waits_on(session):
    check_after(session, 0)
    check_after(session, 3600)
    check_after(session, 1)
    session.client.workers = {"tcp://127.0.0.1:1": 1}
    check_after(session, 3600)
    session.client.workers = {}
    check_after(session, 1, times=20)
    with pytest.raises(ClusterLost, match="for 20 s"):
        check_after(session, 1, times=3)


# --- workers that are left out --------------------------------------------------------------------------

CHECK = "check"


@dataclass
class Worker:
    """A worker that does jobs in this process."""

    address: str
    answer: object = ""
    """What the probe gives: a proof, or an error that it raises."""
    versions: dict = field(default_factory=workers.versions)
    """Versions of the client that it compares with its own."""
    dies: bool = False
    stays: int = 1000
    """Number of jobs after which it leaves, before the session knows."""
    done: int = 0

    def __post_init__(self):
        self.answer = self.answer or f"proof of {self.address}"
        check = WorkerCheck(self.versions, MadeProbe(self.answer))
        check.setup(self)
        self.plugins = {CHECK: check}


@dataclass
class MadeProbe:
    answered: object
    refused: tuple[str, ...] = ()
    taken: set = field(default_factory=set)

    def answer(self, job):
        if isinstance(self.answered, OSError):
            raise self.answered
        return self.answered

    def accept(self, proof):
        # A proof is taken once, as the files of a worker are removed.
        assert proof not in self.taken
        self.taken.add(proof)
        if proof in self.refused:
            raise OSError(f"{proof} is not accepted")


class MadeFuture:
    def __init__(self, result=None, error=None):
        self.value, self.error, self.status = result, error, "error" if error else "finished"

    def result(self, timeout):
        return self.value

    def exception(self):
        return self.error

    def done(self):
        return self.status != "pending"

    def release(self):
        pass

    def add_done_callback(self, call):
        if self.done():
            call(self)


class WorkingClient(Client):
    """A client whose jobs are done at once, in turn by all workers that may."""

    def __init__(self, *there, monkeypatch):
        self.there = {worker.address: worker for worker in there}
        self.turns, self.checks, self.events, self.patch = count(), count(), [], monkeypatch

    def nthreads(self):
        assert next(self.checks) < 1000
        return dict.fromkeys(self.there, 1)

    def get_events(self, topic):
        return self.events

    def submit(self, function, packed, check, accepted, *, workers, **options):
        self.there = {name: worker for name, worker in self.there.items() if worker.done < worker.stays}
        able = [worker for address, worker in self.there.items() if address in (workers or self.there)]
        if not able:
            future = MadeFuture()
            future.status = "pending"
            return future
        worker = able[next(self.turns) % len(able)]
        self.patch.setattr("flexroad.pipeline.execute.workers.get_worker", lambda: worker)
        answer = function(packed, check, accepted)
        if worker.dies and answer[-1] is not None:
            self._replace(worker)
            return MadeFuture(error=KilledWorker("job", worker.state, 0))
        worker.done += answer[-1] is not None
        return MadeFuture(answer)

    def _replace(self, worker):
        del self.there[worker.address]
        worker.state = SimpleNamespace(address=worker.address, memory_limit=700 * 1024**2)
        self.events.append((0, {"worker": worker.address, "rss": 800 * 1024**2}))
        new = Worker(f"tcp://new:{next(self.turns)}", dies=True)
        self.there[new.address] = new


@pytest.fixture
def working(monkeypatch):
    """Make a session of some workers; returns it and the list of its lines."""
    seconds = count()
    monkeypatch.setattr(module, "TICK_S", 0.01)
    monkeypatch.setattr(module.time, "monotonic", lambda: float(next(seconds)))
    # The timer of a job would end the test process.
    monkeypatch.setattr("faulthandler.dump_traceback_later", lambda *_, **__: None)

    def make(*there, jobs=range(20), refused=()):
        client, lines = WorkingClient(*there, monkeypatch=monkeypatch), []
        session = Session(
            client, "", CHECK, str, iter(jobs), lambda job, why: why, 20, 3600,
            lines.append, MadeProbe(None, refused),
        )  # fmt: skip
        return session, lines

    return make


def lines_without_host(lines):
    return [line.partition(" is left out: ")[2] for line in lines]


def test_worker_that_fails_its_probe_gets_no_jobs_and_one_line_tells(working):
    good, *bad = Worker("good"), *(Worker(f"bad {n}", OSError(5, "is gone", "/run")) for n in range(2))
    session, lines = working(*bad, good)
    assert sorted(session.results()) == sorted(map(str, range(20)))
    assert good.done == 20
    # Both have the same fault and are on the same host.
    (line,) = lines
    assert line == f"worker bad 0 on {socket.gethostname()} is left out: /run: is gone"


def test_worker_whose_proof_is_not_accepted_gets_no_jobs(working):
    good, bad = Worker("good", "good proof"), Worker("bad", "bad proof")
    session, lines = working(bad, good, refused=("bad proof",))
    assert sorted(session.results()) == sorted(map(str, range(20)))
    assert (good.done, bad.done) == (20, 0)
    assert lines_without_host(lines) == ["bad proof is not accepted"]


@pytest.mark.parametrize("name", ["numpy", workers.CODE])
def test_worker_with_other_version_or_code_gets_no_jobs(name, working):
    good, bad = Worker("good"), Worker("bad", versions=workers.versions() | {name: "1.0"})
    session, lines = working(bad, good)
    assert len(list(session.results())) == 20
    assert (good.done, bad.done) == (20, 0)
    (text,) = lines_without_host(lines)
    assert text == f"{name} is {workers.versions()[name]} there and 1.0 here; {workers.SAME}"


def test_worker_that_cannot_load_the_check_gets_no_jobs(working):
    good, bad = Worker("good"), Worker("bad")
    bad.plugins = {}
    session, lines = working(bad, good)
    assert len(list(session.results())) == 20
    assert lines_without_host(lines) == ["it cannot load this version of flexroad; install it there"]


def test_session_without_any_able_worker_ends_with_one_error(working):
    session, lines = working(*(Worker(f"bad {n}", OSError(f"fault {n}")) for n in range(3)))
    with pytest.raises(
        ConfigError, match="no worker was left for 20 s; worker bad . on .* left out: fault ."
    ):
        list(session.results())
    assert [Counter(line[:7] for line in lines)["worker "], lines[-1][:20]] == [3, "no worker is left; w"]


def test_session_that_loses_its_only_able_worker_can_be_resumed(working):
    good, bad = Worker("good"), Worker("bad", OSError("fault"))
    session, _ = working(good, bad)
    results = session.results()
    done = [next(results) for _ in range(5)]
    del session.client.there["good"]
    with pytest.raises(ClusterLost, match="no worker was left for 20 s; worker bad on .* left out: fault"):
        done.extend(results)
    assert 5 <= len(done) < 20


def join_when_none_is_left(session, worker):
    notify = session.notify

    def join(line):
        notify(line)
        if line.startswith("no worker is left"):
            session.client.there[worker.address] = worker

    session.notify = join


def test_able_worker_that_joins_later_gets_the_jobs(working):
    session, lines = working(Worker("bad", OSError("fault")))
    join_when_none_is_left(session, Worker("good"))
    assert sorted(session.results()) == sorted(map(str, range(20)))
    assert len(lines) == 2


def test_jobs_of_a_worker_that_left_before_they_started_go_to_another(working):
    bad, good = Worker("bad", OSError("fault")), Worker("good", stays=8)
    session, _ = working(bad, good)
    join_when_none_is_left(session, Worker("other"))
    assert sorted(session.results()) == sorted(map(str, range(20)))
    assert good.done == 8


@pytest.mark.parametrize("status", ["lost", "finished"])
def test_result_that_is_not_fetched_in_time_is_lost_only_with_its_worker(status, working, monkeypatch):
    """A worker holds its results, and may take long to answer."""
    session, _ = working(Worker("good"))
    late = []

    def result(future, timeout):
        if len(late) < 3:
            late.append(future)
            future.status = status
            raise TimeoutError
        return future.value

    monkeypatch.setattr(MadeFuture, "result", result)
    assert sorted(session.results()) == sorted(map(str, range(20)))
    assert len({*map(id, late)}) == (3 if status == "lost" else 1)


def test_workers_that_all_die_for_memory_end_the_session(working):
    session, _ = working(*(Worker(f"small {n}", dies=True) for n in range(2)), jobs=range(100))
    with pytest.raises(
        ConfigError, match=r"^20 worker processes died .* \(700.00 MiB\), and no tile was done; "
    ):
        list(session.results())


def test_workers_that_die_for_memory_after_a_job_was_done_lose_only_their_jobs(working):
    session, _ = working(*(Worker(f"small {n}", dies=True) for n in range(2)), jobs=range(30))
    session.done = 1
    results = list(session.results())
    assert len(results) == 30
    assert all("at last for memory" in why for why in results)
