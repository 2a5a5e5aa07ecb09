"""The Dask executor: jobs on worker processes of this machine, or on another Dask cluster."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Callable, Generator, Iterable, Iterator
from dataclasses import dataclass
from itertools import chain, islice
from pathlib import Path
from typing import Any

from flexroad.catalog.text import Notify, without_credentials
from flexroad.pipeline.config.models import Cluster
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.execute.executor import Executor, J, Lost, Probe, R

LOCAL = Cluster()
ADDRESS = re.compile(r"((tcp|tls|ws|wss|ucx)://)?([^\s:/@\[\]]+|\[[^\s/\[\]]+\]):\d{1,5}")
"""Address of a scheduler."""


def check_address(address: str) -> None:
    """Check that a text is the address of a scheduler."""
    if not ADDRESS.fullmatch(address):
        raise ConfigError(
            f"{without_credentials(address)!r} is no address of a Dask scheduler; give its host and port, as "
            "tcp://host:8786 or tls://host:8786"
        )


@dataclass(frozen=True)
class DaskExecutor:
    """Runs jobs on local worker processes of one thread each, or on another Dask cluster."""

    workers: int | None = None
    """Number of processes; by default the number in ``cluster``."""
    scheduler: str | None = None
    """Address of a running Dask scheduler, which is used instead of ``cluster``."""
    cluster: Cluster = LOCAL
    """The kind and size of the cluster, and how long to wait for workers."""
    dashboard: bool = False
    """Whether Dask's dashboard is served; its address is passed to ``notify``."""
    notify: Notify = lambda line: None
    """Prints one line for the user: the address of the dashboard, a wait for workers."""
    logs: Path | None = None
    """Folder for the output of SLURM jobs, on a disk that all machines share. By default it is in the home
    folder, and is removed at the end."""

    def map(
        self, function: Callable[[J], R], jobs: Iterable[J], lost: Lost[J, R], probe: Probe | None = None
    ) -> Generator[R, None, None]:
        """Yield results as tiles finish."""
        queue = iter(jobs)
        first = list(islice(queue, 1))
        if not first:
            # Without jobs no cluster is started.
            return
        # The probe is left after the workers have ended, because they may still write its files.
        with probe or contextlib.nullcontext(), self.held() as connected:
            yield from connected.map(function, chain(first, queue), lost, probe)

    @contextlib.contextmanager
    def held(self) -> Iterator[_ConnectedExecutor]:
        """Start the cluster or connect to it, for several calls of `map` of the executor that is yielded."""
        if self.scheduler:
            check_address(self.scheduler)
        # A run with nothing to do, which comes no further, starts without Dask.
        from flexroad.pipeline.execute import clusters  # noqa: PLC0415

        with (
            clusters.quiet(),
            clusters.open_cluster(
                self.cluster, self.workers, self.scheduler, self.dashboard, self.logs, self.notify
            ) as target,
            clusters.connected(target, self.dashboard, self.notify) as client,
        ):
            yield _ConnectedExecutor(client, target, self.cluster, self.notify)


@dataclass(frozen=True)
class _ConnectedExecutor(Executor):
    """Runs jobs on the workers of a connected cluster."""

    client: Any
    target: Any
    cluster: Cluster
    notify: Notify

    def map(
        self, function: Callable[[J], R], jobs: Iterable[J], lost: Lost[J, R], probe: Probe | None = None
    ) -> Generator[R, None, None]:
        """Yield results as tiles finish; the caller has entered ``probe``."""
        # A run with nothing to do, which comes no further, starts without Dask.
        from flexroad.pipeline.execute import session, workers  # noqa: PLC0415

        jobs_on_cluster = session.Session(
            self.client,
            self.target.name,
            workers.check_workers(self.client, self.target.name, probe),
            function,
            iter(jobs),
            lost,
            self.target.worker_lost_timeout_s,
            self.cluster.tile_timeout_s,
            self.notify,
            probe,
        )
        yield from jobs_on_cluster.results()
