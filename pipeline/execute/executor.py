"""The interface of all executors, the executor without workers, and the adaptive executor.

The adaptive executor runs jobs in this process as long as worker processes would not save time. If ``n`` jobs
of ``t`` seconds each are left, they take ``n * t`` seconds here and ``START_S + n * t / w`` seconds on ``w``
workers. Workers are started if they save a multiple of their start time. They are also started for more than
`MANY` jobs: a job that ends or blocks its process must not end or block the run. Each job done here
refines ``t``. Workers that were started stay.

All times are CPU times: other programs delay both jobs here and the start of workers, so that wall times
cannot be compared. Before jobs were measured, ``t`` is their median time in an earlier run.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from types import TracebackType
from typing import Any, Generic, Protocol, TypeVar

from flexroad.catalog.text import Notify, count

J = TypeVar("J")
R = TypeVar("R")
Lost = Callable[[J, str], R]
"""Takes a job and the reason, returns the result of a job whose worker process died twice."""
START_S = 12.0
"""CPU time per core of the start of workers (s): processes, imports, compiled code. Measured: runs of 48
tiles took 25 s more with two workers than with none."""
MARGIN = 1.25
"""Workers must save this many times their start time if `ENOUGH` jobs were measured."""
UNSURE_MARGIN = 3.0
"""The same before that: a time of fewer jobs, or of an earlier run, may be far off."""
ENOUGH = 4
"""Number of measured jobs whose mean time is reliable."""
MANY = 200
"""Largest number of jobs for which workers may be left out."""


class Probe(Protocol):
    """Checks that a worker can do the jobs; a context manager in the process that has the jobs.

    It is pickled for the workers.
    """

    def __enter__(self) -> Any: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...

    def answer(self, job: Any) -> Any:
        """Check a worker, in its process and with its first job; return the proof for `accept`.

        Raises
        ------
        OSError
            If the worker cannot do the jobs.
        """

    def accept(self, proof: Any) -> None:
        """Check the proof of a worker, in the process that has the jobs.

        Raises
        ------
        OSError
            If the worker cannot do the jobs.
        """


class Executor(Protocol):
    """Applies a function to jobs."""

    def map(
        self, function: Callable[[J], R], jobs: Iterable[J], lost: Lost[J, R], probe: Probe | None = None
    ) -> Generator[R, None, None]:
        """Yield results in the order of completion, with a bounded number of jobs in flight.

        Parameters
        ----------
        function : callable
            Takes a job, returns its result; runs in the worker processes.
        jobs : iterable
            The jobs; taken one by one as workers become free.
        lost : callable
            Gives the result of a job that is lost (`Lost`).
        probe : Probe, optional
            Check of each worker process before its first job. A worker that fails gets no job.

        Raises
        ------
        ConfigError
            If no worker can do the jobs: no workers, other versions, other files, too little memory.
        ClusterLost
            If the scheduler is lost, or all workers for too long; results yielded before are valid.
        """

    def held(self) -> AbstractContextManager[Executor]:
        """Return a context manager of an executor whose calls of `map` use the same workers, if any."""
        return nullcontext(self)


class SerialExecutor(Executor):
    """Runs one job after the other in this process."""

    def map(
        self, function: Callable[[J], R], jobs: Iterable[J], lost: Lost[J, R], probe: Probe | None = None
    ) -> Generator[R, None, None]:
        """Yield results in the order of the jobs; ``probe`` is not needed: there is no worker."""
        for job in jobs:
            yield function(job)


@dataclass(frozen=True)
class Jobs(Generic[J]):
    """Jobs of a known number; iterated once."""

    source: Iterator[J]
    number: int
    job_s: float | None = None
    """Median time of such jobs in an earlier run (s), or None."""
    log: Notify = lambda line: None
    """Takes each decision as a line."""

    def __iter__(self) -> Iterator[J]:
        return self.source


def estimate(times: Sequence[float], known_s: float | None) -> tuple[float | None, bool]:
    """Return the CPU time of one more job (s), None if unknown, and whether `ENOUGH` jobs were measured.

    - `times`: CPU times (s) of the jobs done in this process, in their order. The first job is left out,
      because it also loads libraries. The longest is left out, because a later job may load further ones.
    - `known_s`: median time in an earlier run (s), used before jobs were measured.
    """
    measured = sorted(times[1:])
    if len(measured) < 2:
        return known_s, False
    return sum(measured[:-1]) / (len(measured) - 1), len(measured) >= ENOUGH


def workers_of(asked: int | None) -> int:
    """Return how many workers can work at the same time here, of the number asked for (None: any)."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return min(asked or cores, cores)


def workers_pay(number: int, workers: int, job_s: float | None, sure: bool = False) -> bool:
    """Return whether worker processes save time for jobs of a time (s) from `estimate`."""
    if number > MANY or job_s is None:
        return number > MANY
    return number * job_s * (1 - 1 / workers) > (MARGIN if sure else UNSURE_MARGIN) * START_S


def decision(number: int, workers: int, job_s: float | None, sure: bool = False) -> str:
    """Return one line on where ``number`` jobs run, and why."""
    what = count(number, "tile") + (f" of about {job_s:.2g} s" if job_s is not None else "")
    if number > MANY:
        return f"worker processes: {what}"
    if workers_pay(number, workers, job_s, sure):
        return (
            f"worker processes: {what}; {workers} of them save more than their start of about {START_S:g} s"
        )
    if job_s is None:
        return f"no worker processes yet: {what}, the first ones show whether workers pay"
    return f"no worker processes: {what}, less work than the start of {workers}"


class AdaptiveExecutor(Executor):
    """Runs jobs in this process until workers would save time; the other jobs run on workers.

    - `workers`: largest number of worker processes; by default one per core.
    """

    def __init__(self, workers: int | None, parallel: Executor, notify: Notify) -> None:
        self.workers = workers_of(workers)
        self.parallel = parallel
        self.notify = notify

    def map(
        self, function: Callable[[J], R], jobs: Iterable[J], lost: Lost[J, R], probe: Probe | None = None
    ) -> Generator[R, None, None]:
        """Yield results: first of the jobs done here, in their order, then of the jobs done by workers."""
        if not isinstance(jobs, Jobs):
            yield from self.parallel.map(function, jobs, lost, probe)
            return
        if not jobs.number:
            return
        rest, left, times = iter(jobs), jobs.number, list[float]()
        self._tell(jobs, left, times)
        while not workers_pay(left, self.workers, *estimate(times, jobs.job_s)):
            if left == 0:
                return
            left -= 1
            start = time.process_time()
            result = function(next(rest))
            times.append(time.process_time() - start)
            yield result
        if left < jobs.number:
            self._tell(jobs, left, times)
        yield from self.parallel.map(function, rest, lost, probe)

    def _tell(self, jobs: Jobs[J], left: int, times: Sequence[float]) -> None:
        line = decision(left, self.workers, *estimate(times, jobs.job_s))
        jobs.log(line)
        self.notify(line)
