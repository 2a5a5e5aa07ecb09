"""Dask clusters: on this machine, already running, or requested from SLURM."""

from __future__ import annotations

import contextlib
import importlib.util
import logging
import time
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import dask
from dask.system import CPU_COUNT
from distributed import Client, LocalCluster
from distributed.security import Security
from distributed.utils import silence_logging_cmgr

from flexroad.catalog.storage.scratch import ScratchFolder
from flexroad.catalog.text import Notify, one_line
from flexroad.pipeline import OF_WORKERS
from flexroad.pipeline.config.models import Cluster
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.execute.slurm import slurm
from flexroad.pipeline.execute.start import (
    available_bytes,
    certificates,
    opened,
    settings,
    start_workers,
    web_address,
)

WORKER_LOST_TIMEOUT_S = 60.0
"""How long to wait for a new worker when all are lost (s); a local worker is replaced in seconds."""
GRACE_S = 10.0
"""How long a running scheduler may have no workers (s): a nanny may be replacing a worker."""
ANSWER_S = 10.0
"""How long a scheduler may take to answer (s)."""


@dataclass(frozen=True)
class ClusterTarget:
    """The cluster that a client connects to."""

    target: Any
    """An address, or a Dask cluster object."""
    name: str
    """The cluster's name in messages."""
    start_s: float = 0
    """How long to wait for the first worker (s)."""
    worker_lost_timeout_s: float = 0
    """How long to wait for a worker when all are lost (s)."""
    remedy: str = "start some (`dask worker ADDRESS --nthreads 1`)"
    """The remedy if no worker comes."""
    given_up: Callable[[], bool] = lambda: False
    """Returns whether no worker can come any more."""


@contextlib.contextmanager
def open_cluster(
    cluster: Cluster,
    workers: int | None,
    scheduler: str | None,
    dashboard: bool,
    logs: Path | None = None,
    notify: Notify = lambda line: None,
) -> Iterator[ClusterTarget]:
    """Connect to, start or request a cluster; on exit, stop it if it was started here.

    ``logs`` is the folder for the output of SLURM jobs, and ``notify`` prints one line about them.
    """
    if scheduler:
        _check_certificates(scheduler)
        if not scheduler.startswith(("tls://", "wss://")):
            notify(
                "a scheduler without tls:// is open to everyone who reaches it, and runs programs as its user"
            )
        yield ClusterTarget(scheduler, f"the Dask scheduler at {scheduler}", GRACE_S, WORKER_LOST_TIMEOUT_S)
        return
    if workers:
        cluster = cluster.model_copy(update={"workers": workers})
    with contextlib.ExitStack() as stack:
        # The settings stay until the cluster ends, so that replacements of dead workers get them too.
        stack.enter_context(dask.config.set(settings(cluster, dashboard)))
        if cluster.kind == "local":
            started = stack.enter_context(local(cluster, dashboard))
            yield ClusterTarget(started, "the local cluster", 0, WORKER_LOST_TIMEOUT_S)
        else:
            jobs = stack.enter_context(slurm(cluster, dashboard, logs, notify))
            yield ClusterTarget(
                jobs.cluster,
                "the slurm cluster",
                cluster.start_s,
                cluster.start_s,
                f"`squeue --me` shows its jobs, {jobs.folder} has their output",
                lambda: jobs.given_up,
            )


def _check_certificates(scheduler: str) -> None:
    """Check that Dask has the certificates for an address."""
    names = "distributed.comm.tls.ca-file, distributed.comm.tls.client.cert and .key"
    try:
        missing = Security().get_connection_args("client")["ssl_context"] is None
    except OSError as error:
        raise ConfigError(
            f"cannot load the certificates of Dask's configuration: {error}; look at {names}"
        ) from error
    if missing and scheduler.startswith(("tls://", "wss://")):
        raise ConfigError(
            f"{scheduler}: Dask has no certificates for it; set {names} in ~/.config/dask/dask.yaml, or "
            "DASK_DISTRIBUTED__COMM__TLS__CA_FILE, ...TLS__CLIENT__CERT and ...TLS__CLIENT__KEY"
        )


@contextlib.contextmanager
def local(cluster: Cluster, dashboard: bool) -> Iterator[Any]:
    """Open a cluster of single-threaded processes on this machine.

    It listens on the loopback interface only.
    """
    workers = cluster.workers or CPU_COUNT
    with ScratchFolder() as scratch, contextlib.ExitStack() as stack:
        make = partial(
            LocalCluster,
            n_workers=0,
            threads_per_worker=1,
            processes=True,
            memory_limit=int(cluster.memory or available_bytes() // workers),
            dashboard_address=web_address(dashboard),
            scheduler_kwargs={"dashboard": dashboard},
            worker_dashboard_address=None,
            local_directory=scratch,
            env=OF_WORKERS,
            silence_logs=logging.CRITICAL,
            security=certificates(cluster),
        )
        try:
            started = stack.enter_context(opened(make))
            start_workers(started, workers)
        except (OSError, RuntimeError) as error:
            raise ConfigError(
                f"cannot start {workers} worker processes here: {one_line(error).rstrip('.')}; use fewer "
                "--workers, or allow more processes and open files (ulimit -u, ulimit -n)"
            ) from error
        yield started


@contextlib.contextmanager
def connected(target: ClusterTarget, dashboard: bool, notify: Notify) -> Iterator[Client]:
    """Connect to a cluster and wait for its first worker; print the dashboard's address if wanted."""
    make = partial(Client, target.target, timeout=ANSWER_S, set_as_default=False)
    with contextlib.ExitStack() as stack:
        try:
            client = stack.enter_context(opened(make))
        except OSError as error:
            raise ConfigError(f"{target.name} does not answer: {error}") from error
        if dashboard:
            has_bokeh = importlib.util.find_spec("bokeh") is not None
            missing = "no dashboard: it needs bokeh (pip install 'flexroad[dashboard]')"
            notify(f"dashboard: {client.dashboard_link}" if has_bokeh else missing)
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


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    """Silence Dask's messages on lost workers, schedulers and versions: FlexRoad reports these itself."""
    with silence_logging_cmgr(logging.CRITICAL), warnings.catch_warnings():
        warnings.filterwarnings("ignore", module="distributed")
        yield
