"""Jobs run in this process until worker processes pay for their start."""

import time

import pytest

from flexroad.pipeline.execute import AdaptiveExecutor, Jobs
from flexroad.pipeline.execute.adaptive import MANY, MARGIN, START_S, decision, workers_of, workers_pay


class Parallel:
    """Records the jobs that it is given, and starts if there is one."""

    def __init__(self):
        self.jobs = []

    def map(self, function, jobs, lost, probe=None):
        for job in jobs:
            self.jobs.append(job)
            yield function(job)


@pytest.fixture
def two_cores(monkeypatch):
    monkeypatch.setattr("flexroad.pipeline.execute.adaptive.workers_of", lambda asked: asked or 2)


def made_clock(monkeypatch, job_s: float, cpu: float = 1.0):
    """Return a job that takes ``job_s`` seconds of a made clock; of these it computes a part ``cpu``."""
    now = [0.0]
    monkeypatch.setattr(time, "perf_counter", lambda: now[0])
    monkeypatch.setattr(time, "process_time", lambda: cpu * now[0])

    def job(number: int) -> int:
        now[0] += job_s
        return 2 * number

    return job


def run(function, number, workers=2, job_s=None, **of_jobs):
    """Return the results, the jobs of the workers and the printed lines."""
    parallel, lines = Parallel(), []
    jobs = Jobs(iter(range(number)), number, job_s, **of_jobs)
    results = AdaptiveExecutor(workers, parallel, lines.append).map(function, jobs, lambda job, why: -1)
    return list(results), parallel.jobs, lines


@pytest.mark.usefixtures("two_cores")
def test_few_short_jobs_run_without_workers(monkeypatch):
    results, on_workers, lines = run(made_clock(monkeypatch, 0.1), 48)
    assert results == [2 * number for number in range(48)]
    assert on_workers == []
    assert lines == ["no worker processes yet: 48 tiles, the first two show whether workers pay"]


@pytest.mark.usefixtures("two_cores")
def test_long_jobs_run_on_workers_from_the_third_on(monkeypatch):
    results, on_workers, lines = run(made_clock(monkeypatch, 2.0), 48)
    assert sorted(results) == [2 * number for number in range(48)]
    assert on_workers == list(range(2, 48))
    assert lines[-1].startswith("worker processes: 46 tiles of about 2 s; 2 of them save more than")


@pytest.mark.usefixtures("two_cores")
def test_known_time_decides_before_the_first_job(monkeypatch):
    logged = []
    _, on_workers, lines = run(made_clock(monkeypatch, 2.0), 48, job_s=2.0, log=logged.append)
    assert on_workers == list(range(48))
    assert logged == lines
    _, on_workers, lines = run(made_clock(monkeypatch, 0.1), 48, job_s=0.1)
    assert on_workers == []
    assert lines == ["no worker processes: 48 tiles of about 0.1 s, less work than the start of 2"]


@pytest.mark.usefixtures("two_cores")
def test_busy_machine_delays_workers_as_it_delays_jobs(monkeypatch):
    """Jobs that wait three quarters of their time for a core say that workers would start as slowly."""
    assert run(made_clock(monkeypatch, 1.2), 24)[1]
    assert not run(made_clock(monkeypatch, 1.2, cpu=0.25), 24)[1]


@pytest.mark.usefixtures("two_cores")
def test_one_worker_never_pays_but_many_jobs_are_isolated(monkeypatch):
    assert not run(made_clock(monkeypatch, 10), MANY, workers=1)[1]
    assert len(run(made_clock(monkeypatch, 10), MANY + 1, workers=1)[1]) == MANY + 1


def test_no_jobs_start_and_print_nothing():
    assert run(None, 0) == ([], [], [])


def test_jobs_of_unknown_number_run_on_workers():
    parallel = Parallel()
    results = AdaptiveExecutor(2, parallel, print).map(lambda job: job, [1, 2], lambda job, why: -1)
    assert list(results) == parallel.jobs == [1, 2]


def test_workers_pay_from_the_break_even_on():
    """With two workers, half of the work is saved."""
    job_s = 2 * MARGIN * START_S / 100
    assert not workers_pay(99, job_s, 2)
    assert workers_pay(101, job_s, 2)
    assert "no worker processes" in decision(99, job_s, 2)
    assert workers_of(1) == 1
