"""The interface of all executors, and the one without workers."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable
from contextlib import AbstractContextManager, nullcontext
from types import TracebackType
from typing import Any, Protocol, TypeVar

J = TypeVar("J")
R = TypeVar("R")


class Probe(Protocol):
    """Checks that a worker can do the jobs; a context manager of the process that has them.

    It is pickled for the workers.
    """

    def __enter__(self) -> Any: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...

    def answer(self, job: Any) -> Any:
        """Check a worker, in its process and with its first job; return the proof that `accept` takes.

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
        self,
        function: Callable[[J], R],
        jobs: Iterable[J],
        lost: Callable[[J, str], R],
        probe: Probe | None = None,
    ) -> Generator[R, None, None]:
        """Yield results in the order of completion, with a bounded number of jobs in flight.

        Parameters
        ----------
        function : callable
            Takes a job, returns its result; runs in the worker processes.
        jobs : iterable
            The jobs; taken one by one as workers become free.
        lost : callable
            Takes a job and the reason, returns the result of a job whose worker process died twice.
        probe : Probe, optional
            Check of each worker process before its first job. A worker that fails gets no job.

        Raises
        ------
        ConfigError
            If no worker can do the jobs: no workers, other versions, other files, too little memory.
        ClusterLost
            If the scheduler is gone, or all workers are gone for too long; results yielded before are valid.
        """

    def held(self) -> AbstractContextManager[Executor]:
        """Return a context manager of an executor whose calls of `map` use the same workers."""


class SerialExecutor:
    """Runs one job after the other in this process."""

    def map(
        self,
        function: Callable[[J], R],
        jobs: Iterable[J],
        lost: Callable[[J, str], R],
        probe: Probe | None = None,
    ) -> Generator[R, None, None]:
        """Yield results in the order of the jobs; ``probe`` is not needed: there is no worker."""
        for job in jobs:
            yield function(job)

    def held(self) -> AbstractContextManager[Executor]:
        """Return a context manager of this executor: there are no workers."""
        return nullcontext(self)
