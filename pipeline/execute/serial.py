"""The serial executor: one job after the other in this process, for debugging."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable

from flexroad.pipeline.execute.executor import J, Probe, R


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
