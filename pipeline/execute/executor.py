"""The interface of all executors."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable
from typing import Protocol, TypeVar

J = TypeVar("J")
R = TypeVar("R")


class Executor(Protocol):
    """Applies a function to jobs."""

    def map(
        self,
        function: Callable[[J], R],
        jobs: Iterable[J],
        lost: Callable[[J, str], R],
        probe: Callable[[], None] | None = None,
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
        probe : callable, optional
            Raises OSError if a process cannot do the work; called in every process before its first job.

        Raises
        ------
        ConfigError
            If the workers cannot do the work: no workers, other versions, a store they cannot write.
        ClusterLost
            If the scheduler is gone, or all workers are gone for too long; results yielded before are valid.
        """
