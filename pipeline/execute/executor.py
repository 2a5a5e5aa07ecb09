"""What every executor does."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable
from typing import Protocol, TypeVar

J = TypeVar("J")
R = TypeVar("R")


class Executor(Protocol):
    """Runs a function over jobs."""

    def map(
        self,
        function: Callable[[J], R],
        jobs: Iterable[J],
        lost: Callable[[J, str], R],
        probe: Callable[[], None] | None = None,
    ) -> Generator[R, None, None]:
        """Yield results as they come, in any order, with a bounded number of jobs in flight.

        Parameters
        ----------
        lost : callable
            Makes the result of a job whose process died more often than is bearable.
        probe : callable, optional
            Raises OSError where no work can be done; called in every process before it works.

        Raises
        ------
        ConfigError
            If the workers cannot do the work: none there, other versions, a store they cannot write.
        ClusterLost
            If the scheduler went away, or all workers for longer than one waits; what is done is done.
        """
