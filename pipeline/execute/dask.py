"""Many jobs at once, on Dask: a window of them in flight, the rest not yet made."""

from __future__ import annotations

import contextlib
import logging
import os
import signal
import tempfile
from collections.abc import Callable, Iterable, Iterator
from itertools import chain, islice
from typing import Any

from pipeline import ONE_THREAD
from pipeline.cluster import Cluster
from pipeline.errors import ConfigError
from pipeline.execute.executor import J, R

LOCAL = Cluster()


class DaskExecutor:
    """Local worker processes of one thread each, or a running cluster.

    Parameters
    ----------
    workers : int, optional
        Number of processes; by default what ``cluster`` says.
    scheduler : str, optional
        Address of a running Dask scheduler, used instead.
    cluster : Cluster
        Who works, and how long is waited for them.
    dashboard : bool
        Serve Dask's dashboard for local workers; where it is goes to ``say``.
    say : callable
        Told in one line what whoever watches wants to know: the dashboard, who is waited for.
    """

    tries = 2

    def __init__(
        self,
        workers: int | None = None,
        scheduler: str | None = None,
        cluster: Cluster = LOCAL,
        dashboard: bool = False,
        say: Callable[[str], None] = lambda line: None,
    ) -> None:
        self.workers = workers
        self.scheduler = scheduler
        self.cluster = cluster
        self.dashboard = dashboard
        self.say = say

    def map(
        self,
        function: Callable[[J], R],
        jobs: Iterable[J],
        lost: Callable[[J, str], R],
        probe: Callable[[], None] | None = None,
    ) -> Iterator[R]:
        """Yield results as tiles finish."""
        from distributed import as_completed

        queue = iter(jobs)
        first = list(islice(queue, 1))
        if not first:
            # Nothing to do needs no workers.
            return
        queue = chain(first, queue)
        with self._client() as client:
            # Twice the threads keeps every worker busy while constant memory holds the rest back.
            window = max(2, 2 * sum(client.nthreads().values()))
            flying: dict[Any, J] = {}
            running = as_completed(raise_errors=False)
            for job in islice(queue, window):
                flying[_submit(client, function, job, running)] = job
            for future in running:
                job = flying.pop(future)
                yield _result(future, job, lost)
                future.release()
                for following in islice(queue, 1):
                    flying[_submit(client, function, following, running)] = following

    @contextlib.contextmanager
    def _client(self) -> Iterator[Any]:
        import dask
        from distributed import Client, LocalCluster

        with contextlib.ExitStack() as stack:
            stack.enter_context(dask.config.set({"distributed.scheduler.allowed-failures": self.tries - 1}))
            if self.scheduler:
                try:
                    client = stack.enter_context(Client(self.scheduler, timeout=10))
                except OSError as error:
                    raise ConfigError(f"no Dask scheduler answers at {self.scheduler}: {error}") from error
                if not client.nthreads():
                    raise ConfigError(f"the Dask scheduler at {self.scheduler} has no workers")
            else:
                scratch = stack.enter_context(tempfile.TemporaryDirectory(prefix="flexroad-"))
                cluster = LocalCluster(
                    n_workers=self.workers or os.cpu_count() or 1,
                    threads_per_worker=1,
                    processes=True,
                    dashboard_address=None,
                    local_directory=scratch,
                    env=ONE_THREAD,
                    silence_logs=logging.CRITICAL,
                )
                stack.enter_context(cluster)
                client = stack.enter_context(Client(cluster))
                client.register_plugin(_deaf_to_ctrl_c())
            yield client


def _deaf_to_ctrl_c() -> Any:
    """Return a plugin for workers of one's own terminal, which sends Ctrl-C to all of its processes.

    The client hears it and ends them; they would only print tracebacks.
    """
    from distributed import WorkerPlugin

    class DeafToCtrlC(WorkerPlugin):  # type: ignore[misc]
        def setup(self, worker: Any) -> None:
            signal.signal(signal.SIGINT, signal.SIG_IGN)

    return DeafToCtrlC()


def _submit(client: Any, function: Callable[[J], R], job: J, running: Any) -> Any:
    # Not pure: the store, not Dask, knows what is done already.
    future = client.submit(function, job, pure=False)
    running.add(future)
    return future


def _result(future: Any, job: J, lost: Callable[[J, str], R]) -> R:
    from distributed import KilledWorker

    try:
        result: R = future.result()
    except KilledWorker as error:
        times = error.allowed_failures + 1
        return lost(job, f"the worker process died {times} times here; too little memory is the usual cause")
    return result
