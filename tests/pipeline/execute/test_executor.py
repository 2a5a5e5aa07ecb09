"""Jobs run in this process until worker processes pay for their start."""

import time

import pytest

from flexroad.pipeline.execute import AdaptiveExecutor, Jobs
from flexroad.pipeline.execute.executor import (
    ENOUGH,
    MANY,
    MARGIN,
    START_S,
    UNSURE_MARGIN,
    decision,
    workers_of,
    workers_pay,
)


class Parallel:
    """Records the jobs that it is given, and starts if there is one."""

    def __init__(self):
        self.jobs = []

    def map(self, function, jobs, lost, probe=None):
        for job in jobs:
            self.jobs.append(job)
            yield function(job)


@pytest.fixture(autouse=True)
def two_cores(monkeypatch):
    monkeypatch.setattr("flexroad.pipeline.execute.executor.workers_of", lambda asked: asked or 2)


def made_clock(monkeypatch, *job_s: float):
    """Return a job that takes ``job_s`` CPU seconds of a made clock: one each, the last for the rest."""
    now = [0.0]
    monkeypatch.setattr(time, "process_time", lambda: now[0])

    def job(number: int) -> int:
        now[0] += job_s[min(number, len(job_s) - 1)]
        return 2 * number

    return job


def run(function, number, workers=2, job_s=None, **of_jobs):
    """Return the results, the jobs of the workers and the printed lines."""
    parallel, lines = Parallel(), []
    jobs = Jobs(iter(range(number)), number, job_s, **of_jobs)
    results = AdaptiveExecutor(workers, parallel, lines.append).map(function, jobs, lambda job, why: -1)
    return list(results), parallel.jobs, lines


BREAK_EVEN_S = 2 * MARGIN * START_S / (48 - ENOUGH - 1)


@pytest.mark.parametrize(
    ("job_s", "expected"),
    [
        pytest.param([0.1], [], id="short jobs"),
        # The first loads libraries, the longest of two measured ones does not count.
        pytest.param([2.0], range(3, 48), id="long jobs"),
        pytest.param([5.0] * 10 + [0.01], range(3, 48), id="later jobs are quick"),
        # Jobs a little above break-even wait for a reliable mean.
        pytest.param([1.2 * BREAK_EVEN_S], range(1 + ENOUGH, 48), id="break-even"),
        # A job that compiles or waits for a library says nothing about the others.
        *(pytest.param([0.1] * n + [50.0] + [0.1] * (6 - n), [], id=f"job {n} is slow") for n in range(6)),
    ],
)
def test_jobs_run_on_workers_as_soon_as_these_pay(monkeypatch, job_s, expected):
    results, on_workers, lines = run(made_clock(monkeypatch, *job_s), 48)
    assert sorted(results) == [2 * number for number in range(48)]
    assert on_workers == [*expected]
    assert lines[0] == "no worker processes yet: 48 tiles, the first ones show whether workers pay"
    assert [line[:18] for line in lines[1:]] == ["worker processes: "] * bool(on_workers)


def test_quick_jobs_before_slow_ones_do_not_keep_workers_away(monkeypatch):
    """Tiles of the first files may be empty: jobs are measured until the last one."""
    _, on_workers, lines = run(made_clock(monkeypatch, 1.0, *[0.01] * 9, 2.0), 100)
    assert 10 < on_workers[0] < 35
    assert on_workers == list(range(on_workers[0], 100))
    assert lines[-1].startswith("worker processes: ")


def test_waiting_for_a_core_is_no_work(monkeypatch):
    """On a busy machine the wall clock runs on while a job waits: the decision is that of an idle machine."""
    monkeypatch.setattr(time, "perf_counter", iter(range(0, 10**6, 100)).__next__)
    assert not run(made_clock(monkeypatch, 0.1), 48)[1]


@pytest.mark.parametrize("number", [4, 16, 48, 150])
@pytest.mark.parametrize("job_s", [0.05, 0.3, 1.0, 3.0, 30.0])
def test_two_workers_take_at_most_the_time_of_one(monkeypatch, number, job_s):
    """By the times that the rule assumes: workers save more than their start."""
    _, on_workers, _ = run(made_clock(monkeypatch, START_S / 4 + job_s, job_s), number)
    start_s = START_S if on_workers else 0
    saved_s = len(on_workers) * job_s * (1 - 1 / 2)
    assert start_s <= saved_s


def test_known_time_decides_before_the_first_job_if_it_is_clear(monkeypatch):
    logged = []
    _, on_workers, lines = run(made_clock(monkeypatch, 2.0), 48, job_s=2.0, log=logged.append)
    assert on_workers == list(range(48))
    assert logged == lines
    _, on_workers, lines = run(made_clock(monkeypatch, 0.1), 48, job_s=0.1)
    assert on_workers == []
    assert lines == ["no worker processes: 48 tiles of about 0.1 s, less work than the start of 2"]


def test_measured_jobs_overrule_a_known_time(monkeypatch):
    """The earlier run waited for a busy machine or a slow disk, or had less to do."""
    assert not run(made_clock(monkeypatch, 0.1), 48, job_s=1.4)[1]
    _, on_workers, lines = run(made_clock(monkeypatch, 2.0), 48, job_s=0.1)
    assert on_workers == list(range(3, 48))
    said = "worker processes: 45 tiles of about 2 s; 2 of them save more than their start"
    assert lines[-1].startswith(said)


def test_one_worker_never_pays_but_many_jobs_are_isolated(monkeypatch):
    assert not run(made_clock(monkeypatch, 10), MANY, workers=1)[1]
    assert len(run(made_clock(monkeypatch, 10), MANY + 1, workers=1)[1]) == MANY + 1


def test_no_jobs_start_and_print_nothing():
    assert run(None, 0) == ([], [], [])


def test_jobs_of_unknown_number_run_on_workers():
    parallel = Parallel()
    results = AdaptiveExecutor(2, parallel, print).map(lambda job: job, [1, 2], lambda job, why: -1)
    assert list(results) == parallel.jobs == [1, 2]


@pytest.mark.parametrize(("sure", "margin"), [(True, MARGIN), (False, UNSURE_MARGIN)])
def test_workers_pay_from_the_break_even_on(sure, margin):
    """With two workers, half of the work is saved."""
    job = 2, 2 * margin * START_S / 100, sure
    assert not workers_pay(99, *job)
    assert workers_pay(101, *job)
    assert "no worker processes" in decision(99, *job)
    assert workers_of(1) == 1
