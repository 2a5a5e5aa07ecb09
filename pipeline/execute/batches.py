"""Jobs of three steps: each by itself, many together on a worker with a GPU, each by itself again.

``prepare`` and the last step run on any worker, a batch on a worker that declares the resource ``GPU``
(``dask worker ADDRESS --nthreads 1 --resources GPU=1``). While a batch runs, the jobs of the next one are
prepared. A batch whose worker dies is halved; a job that is left alone takes the last step by itself.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Generator, Hashable, Iterable, Iterator
from dataclasses import dataclass, field
from functools import partial
from typing import Any, ClassVar, Generic

from flexroad.pipeline.execute.executor import Executor, J, R

GPU = {"GPU": 1}
"""The Dask resource that a batch takes."""
PREFETCH = 2
"""Number of batches whose jobs may be prepared or in preparation."""


@dataclass(frozen=True)
class Ready(Generic[J]):
    """A job that can be a part of a batch, with others of its group."""

    job: J
    group: Hashable


@dataclass(frozen=True)
class First(Generic[J]):
    """The first step of a job."""

    job: J

    @property
    def key(self) -> str:
        """Name on Dask's dashboard."""
        return f"prepare-{getattr(self.job, 'key', 'job')}"


@dataclass(frozen=True)
class Batch(Generic[J]):
    """The step that many jobs take together."""

    jobs: tuple[J, ...]
    key: ClassVar[str] = "batch"
    resources: ClassVar[dict[str, int]] = GPU


@dataclass(frozen=True)
class Last(Generic[J]):
    """The last step of a job."""

    job: J

    @property
    def key(self) -> str:
        """Name on Dask's dashboard."""
        return getattr(self.job, "key", "job")


@dataclass(frozen=True)
class Done(Generic[R]):
    """The result of a job."""

    result: R
    first: bool = False
    """Whether the first step has given it."""


Step = First[J] | Batch[J] | Last[J]


@dataclass
class Feed(Generic[J]):
    """The steps that can be taken at present."""

    source: Iterator[J]
    most: int
    """Largest number of jobs in a batch."""
    preparing: int = 0
    fitting: int = 0
    waiting: dict[Hashable, list[J]] = field(default_factory=dict)
    """Prepared jobs by group."""
    following: deque[Batch[J] | Last[J]] = field(default_factory=deque)

    def steps(self) -> Iterator[Step[J] | None]:
        """Yield steps; None if there is none until the result of another one is taken."""
        while True:
            step = self._next()
            if step is None and not (self.preparing or self.fitting or self.following):
                return
            self.preparing += isinstance(step, First)
            self.fitting += isinstance(step, Batch)
            yield step

    def _next(self) -> Step[J] | None:
        if self.following:
            return self.following.popleft()
        group = max(self.waiting, key=lambda name: len(self.waiting[name]), default=None)
        if group is not None and len(self.waiting[group]) >= self.most:
            return self._batch(group)
        if self.preparing + sum(map(len, self.waiting.values())) < PREFETCH * self.most:
            for job in self.source:
                return First(job)
        if group is not None and not (self.preparing or self.fitting):
            return self._batch(group)
        return None

    def _batch(self, group: Hashable) -> Batch[J]:
        jobs = self.waiting.pop(group)
        if jobs[self.most :]:
            self.waiting[group] = jobs[self.most :]
        return Batch(tuple(jobs[: self.most]))

    def take(self, outcome: Any) -> None:
        """Take what a step has returned."""
        if isinstance(outcome, Ready):
            self.preparing -= 1
            self.waiting.setdefault(outcome.group, []).append(outcome.job)
        elif isinstance(outcome, Batch):
            # Its worker died.
            self.fitting -= 1
            half = len(outcome.jobs) // 2
            parts = (outcome.jobs[:half], outcome.jobs[half:]) if half else ()
            self.following.extend(map(Batch, parts) if parts else map(Last, outcome.jobs))
        elif isinstance(outcome, Done):
            self.preparing -= outcome.first
        else:
            self.fitting -= 1
            self.following.extend(map(Last, outcome))


class BatchExecutor:
    """Runs jobs in three steps on another executor.

    Parameters
    ----------
    executor : Executor
        Runs the steps.
    prepare : callable
        Takes a job, returns it as `Ready`, or its result if it needs no batch.
    together : callable
        Takes the jobs of a batch, returns them as the last step takes them.
    most : int
        Largest number of jobs in a batch.
    """

    def __init__(
        self,
        executor: Executor,
        prepare: Callable[[Any], Any],
        together: Callable[[tuple[Any, ...]], list[Any]],
        most: int,
    ) -> None:
        self.executor = executor
        self.prepare = prepare
        self.together = together
        self.most = most

    def map(
        self,
        function: Callable[[J], R],
        jobs: Iterable[J],
        lost: Callable[[J, str], R],
        probe: Callable[[], None] | None = None,
    ) -> Generator[R, None, None]:
        """Yield results as jobs finish; ``function`` is the last step."""
        feed = Feed(iter(jobs), self.most)
        take_step = partial(_take_step, self.prepare, self.together, function)
        steps: Iterator[Any] = feed.steps()
        outcomes: Generator[Any, None, None]
        outcomes = self.executor.map(take_step, steps, partial(_lost, lost), probe)
        try:
            for outcome in outcomes:
                feed.take(outcome)
                if isinstance(outcome, Done):
                    yield outcome.result
        finally:
            outcomes.close()


def _take_step(
    prepare: Callable[[J], Ready[J] | R],
    together: Callable[[tuple[J, ...]], list[J]],
    function: Callable[[J], R],
    step: Step[J],
) -> Any:
    if isinstance(step, Batch):
        return together(step.jobs)
    if isinstance(step, Last):
        return Done(function(step.job))
    ready = prepare(step.job)
    return ready if isinstance(ready, Ready) else Done(ready, first=True)


def _lost(lost: Callable[[J, str], R], step: Step[J], reason: str) -> Any:
    if isinstance(step, Batch):
        return step
    return Done(lost(step.job, reason), isinstance(step, First))
