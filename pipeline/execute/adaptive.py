"""The adaptive executor: jobs run in this process as long as worker processes would not pay for their start.

With ``n`` jobs left of ``t`` seconds each, ``w`` workers save ``n * t * (1 - 1 / w)`` seconds. They are
started if that is more than `MARGIN` times their start, or if there are more than `MANY` jobs: then a job
that ends or blocks its process must not end or block the run. ``t`` is the median time in an earlier run,
and from the second job on the mean time here. On a machine with other work to do, the start takes longer by
the same factor as the jobs: their wall time over their CPU time.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Generator, Iterable, Iterator
from dataclasses import dataclass
from typing import Generic

from flexroad.catalog.text import count
from flexroad.pipeline.execute.executor import Executor, J, R

START_S = 4.0
"""Time until new workers do their first job (s): their start, imports and compiled code, on idle cores."""
MARGIN = 3.0
"""How many times their start workers must save: times of jobs are estimates."""
MANY = 200
"""Largest number of jobs for which workers may be left out."""


@dataclass(frozen=True)
class Jobs(Generic[J]):
    """Jobs of a known number; iterated once."""

    source: Iterator[J]
    number: int
    job_s: float | None = None
    """Median time of such jobs in an earlier run (s), None if there was none."""
    log: Callable[[str], None] = lambda line: None
    """Takes each decision, one line."""

    def __iter__(self) -> Iterator[J]:
        return self.source


class Pace:
    """The time of the jobs done in this process. The first one also loads libraries, so it is not counted."""

    def __init__(self, job_s: float | None) -> None:
        self.job_s = job_s
        """Estimated time of one more job (s), None if unknown."""
        self.slowdown = 1.0
        """Wall time over CPU time."""
        self.times: list[float] = []
        self.cpu_s = 0.0

    def run(self, function: Callable[[J], R], job: J) -> R:
        """Do a job and measure it."""
        wall, cpu = time.perf_counter(), time.process_time()
        result = function(job)
        self.times.append(time.perf_counter() - wall)
        self.cpu_s += time.process_time() - cpu
        self.slowdown = max(1.0, sum(self.times) / max(self.cpu_s, 1e-3))
        if len(self.times) > 1:
            self.job_s = sum(self.times[1:]) / (len(self.times) - 1)
        return result


def workers_of(asked: int | None) -> int:
    """Return how many workers can work at the same time here, of the number asked for (None: any)."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return min(asked or cores, cores)


def workers_pay(number: int, job_s: float | None, workers: int, slowdown: float = 1.0) -> bool:
    """Return whether ``workers`` processes are worth their start for ``number`` jobs of ``job_s`` seconds."""
    if number > MANY:
        return True
    return job_s is not None and number * job_s * (1 - 1 / workers) > MARGIN * START_S * slowdown


def decision(number: int, job_s: float | None, workers: int, slowdown: float = 1.0) -> str:
    """Return one line on where ``number`` jobs run, and why."""
    what = count(number, "tile") + (f" of about {job_s:.2g} s" if job_s is not None else "")
    if number > MANY:
        return f"worker processes: {what}"
    if workers_pay(number, job_s, workers, slowdown):
        return f"worker processes: {what}; {workers} of them save more than {MARGIN:g} times their start"
    if job_s is None:
        return f"no worker processes yet: {what}, the first two show whether workers pay"
    return f"no worker processes: {what}, less work than the start of {workers}"


class AdaptiveExecutor:
    """Runs jobs in this process until workers pay for their start; the rest on workers.

    Parameters
    ----------
    workers : int, optional
        Largest number of worker processes; by default one per core.
    parallel : Executor
        Runs the jobs on the workers.
    say : callable
        Prints each decision, one line.
    """

    def __init__(self, workers: int | None, parallel: Executor, say: Callable[[str], None]) -> None:
        self.workers = workers_of(workers)
        self.parallel = parallel
        self.say = say

    def map(
        self,
        function: Callable[[J], R],
        jobs: Iterable[J],
        lost: Callable[[J, str], R],
        probe: Callable[[], None] | None = None,
    ) -> Generator[R, None, None]:
        """Yield results: first of the jobs done here, in their order, then of those done by workers."""
        if not isinstance(jobs, Jobs):
            yield from self.parallel.map(function, jobs, lost, probe)
            return
        if not jobs.number:
            return
        rest, left, pace = iter(jobs), jobs.number, Pace(jobs.job_s)
        self._tell(jobs, left, pace)
        while not workers_pay(left, pace.job_s, self.workers, pace.slowdown):
            if left == 0:
                return
            left -= 1
            yield pace.run(function, next(rest))
        if left < jobs.number:
            self._tell(jobs, left, pace)
        yield from self.parallel.map(function, rest, lost, probe)

    def _tell(self, jobs: Jobs[J], left: int, pace: Pace) -> None:
        line = decision(left, pace.job_s, self.workers, pace.slowdown)
        jobs.log(line)
        self.say(line)
