"""One job after the other in this process; the executor to debug with."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable

from flexroad.pipeline.execute.executor import J, R


class SerialExecutor:
    """One job after the other in this process."""

    def map(
        self,
        function: Callable[[J], R],
        jobs: Iterable[J],
        lost: Callable[[J, str], R],
        probe: Callable[[], None] | None = None,
    ) -> Generator[R, None, None]:
        """Yield results in the jobs' order; whoever calls has probed this process already."""
        for job in jobs:
            yield function(job)
