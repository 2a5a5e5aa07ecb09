"""The Dask executor: connect to a cluster, check its workers, and submit jobs."""

from __future__ import annotations

import contextlib
import logging
import time
import uuid
import warnings
from collections.abc import Callable, Generator, Iterable, Iterator
from functools import partial
from itertools import chain, islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

from flexroad.pipeline.config.cluster import Cluster
from flexroad.pipeline.errors import ClusterLost, ConfigError
from flexroad.pipeline.execute.clusters import ClusterTarget, open_cluster
from flexroad.pipeline.execute.executor import J, Probe, R
from flexroad.pipeline.execute.start import opened

if TYPE_CHECKING:
    from distributed import Client

LOCAL = Cluster()
ANSWER_S = 10.0
"""How long a scheduler may take to answer (s)."""


class DaskExecutor:
    """Runs jobs on local worker processes of one thread each, or on another Dask cluster.

    Parameters
    ----------
    workers : int, optional
        Number of processes; by default that of ``cluster``.
    scheduler : str, optional
        Address of a running Dask scheduler, which is used instead of ``cluster``.
    cluster : Cluster
        The kind and size of the cluster, and how long to wait for workers.
    dashboard : bool
        Serve Dask's dashboard; its address is passed to ``say``.
    say : callable
        Prints one line for the user: the address of the dashboard, a wait for workers.
    logs : Path, optional
        Folder for the output of SLURM jobs, on a disk that all machines share; by default one in the home
        folder, which is removed at the end.
    """

    def __init__(
        self,
        workers: int | None = None,
        scheduler: str | None = None,
        cluster: Cluster = LOCAL,
        dashboard: bool = False,
        say: Callable[[str], None] = lambda line: None,
        logs: Path | None = None,
    ) -> None:
        self.workers = workers
        self.scheduler = scheduler
        self.cluster = cluster
        self.dashboard = dashboard
        self.say = say
        self.logs = logs

    def map(
        self,
        function: Callable[[J], R],
        jobs: Iterable[J],
        lost: Callable[[J, str], R],
        probe: Probe | None = None,
    ) -> Generator[R, None, None]:
        """Yield results as tiles finish."""
        queue = iter(jobs)
        first = list(islice(queue, 1))
        if not first:
            # Without jobs no cluster is started.
            return
        from flexroad.pipeline.execute.session import Session

        with (
            _quiet(),
            # Left after the workers have ended, which may still write files of the probe.
            probe or contextlib.nullcontext(),
            open_cluster(
                self.cluster, self.workers, self.scheduler, self.dashboard, self.logs, self.say
            ) as target,
            self._connected(target) as client,
        ):
            check = _check_workers(client, target, probe)
            session = Session(
                client,
                target.name,
                check,
                function,
                chain(first, queue),
                lost,
                self.cluster.model_copy(update={"patience_s": target.patience_s}),
                self.say,
                probe,
            )
            yield from session.results()

    @contextlib.contextmanager
    def _connected(self, target: ClusterTarget) -> Iterator[Client]:
        from distributed import Client

        make = partial(Client, target.target, timeout=ANSWER_S, set_as_default=False)
        with contextlib.ExitStack() as stack:
            try:
                client = stack.enter_context(opened(make))
            except OSError as error:
                raise ConfigError(f"{target.name} does not answer: {error}") from error
            if self.dashboard:
                self.say(_dashboard(client))
            if not _any_worker(client, target):
                raise ConfigError(f"{target.name} has no workers; {target.remedy}")
            yield client


def _any_worker(client: Client, target: ClusterTarget) -> bool:
    end = time.monotonic() + target.start_s
    with contextlib.suppress(OSError):
        while not client.nthreads():
            if time.monotonic() > end or target.given_up():
                return False
            time.sleep(0.2)
        return True
    return False


def _check_workers(client: Client, target: ClusterTarget, probe: Probe | None) -> str:
    """Compare the versions that pickling needs, register the plugins; return the name of the `WorkerCheck`.

    Raises
    ------
    ConfigError
        If a process has other versions of these, or cannot load flexroad.
    ClusterLost
        If the scheduler no longer answers.
    """
    from flexroad.pipeline.execute import workers
    from flexroad.pipeline.execute.scheduler import retry_blocker

    here = workers.versions()
    name = uuid.uuid4().hex[:8]
    try:
        _compare(client, here)
        client.register_plugin(retry_blocker(client.id, name), name=f"flexroad-{name}")
        _register(client, workers.WorkerCheck(here, probe), name)
    except ConfigError:
        raise
    except OSError as error:
        raise ClusterLost(f"{target.name} went away before its first tile: {error}") from error
    except Exception as error:
        # Unpickling on the cluster may raise any type of error.
        reason = " ".join(str(error).split()) or repr(error)
        raise ConfigError(
            f"{target.name} cannot load flexroad ({reason}); install it for the workers, and let the "
            "scheduler accept plugins (distributed.scheduler.pickle)"
        ) from error
    return name


def _register(client: Client, plugin: Any, name: str) -> None:
    """Register a plugin on all workers; retried if a worker dies meanwhile."""
    for retries_left in range(4, -1, -1):
        try:
            client.register_plugin(plugin, name=name)
            return
        except OSError:
            if not retries_left:
                raise
            time.sleep(1)


def _compare(client: Client, here: dict[str, str]) -> None:
    """Compare the versions that Dask reports: with very different ones no plugin could be unpickled.

    Raises
    ------
    ConfigError
        If the versions of the scheduler or of a worker differ from those here.
    """
    from flexroad.pipeline.execute.workers import PICKLING

    here = {name: here[name] for name in PICKLING}
    reported = client.get_versions(packages=list(PICKLING[1:]))
    _compare_process("the scheduler", reported["scheduler"], here)
    for address, worker in reported["workers"].items():
        _compare_process(f"worker {address}", worker, here)


def _compare_process(name: str, reported: Any, here: dict[str, str]) -> None:
    from flexroad.pipeline.execute.workers import difference, version_error

    there = {package: reported["packages"].get(package) or "missing" for package in here}
    there["python"] = ".".join(reported["host"]["python"].split(".")[:3])
    different = difference(there, here)
    if different:
        raise ConfigError(version_error(name, different))


def _dashboard(client: Client) -> str:
    try:
        import bokeh  # noqa: F401
    except ImportError:
        return "no dashboard: it needs bokeh (pip install 'flexroad[dashboard]')"
    return f"dashboard: {client.dashboard_link}"


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Silence Dask's messages on lost workers, schedulers and versions: FlexRoad reports these itself."""
    from distributed.utils import silence_logging_cmgr

    with silence_logging_cmgr(logging.CRITICAL), warnings.catch_warnings():
        warnings.filterwarnings("ignore", module="distributed")
        yield
