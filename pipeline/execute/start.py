"""Start of a cluster from this process: Dask's settings, certificates and memory, and the start itself."""

from __future__ import annotations

import asyncio
import contextlib
import importlib
import os
import signal
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from multiprocessing import resource_tracker
from pathlib import Path
from typing import Any, TypeVar

from distributed.security import Security
from distributed.system import MEMORY_LIMIT

from flexroad.pipeline import OF_WORKERS
from flexroad.pipeline.config.models import Cluster
from flexroad.pipeline.errors import ConfigError
from flexroad.tasks.memory import MOUNT, OWN, group_limits

T = TypeVar("T")
SETTINGS = {
    "distributed.worker.memory.target": False,
    "distributed.worker.memory.spill": False,
    "distributed.worker.memory.pause": False,
    "distributed.worker.memory.terminate": 0.95,
    "distributed.worker.profile.enabled": False,
    "distributed.admin.log-length": 1000,
    "distributed.admin.system-monitor.log-length": 240,
    "distributed.nanny.pre-spawn-environ": OF_WORKERS,
}
"""Dask settings of all workers. Dask's defaults suit data frames that are kept in workers. A tile leaves
nothing to spill to disk, and a paused worker would wait forever for its only tile to free memory. So the
worker is ended at the limit. Profiling would cost 2% of a tile's time. The logs of scheduler and monitor are
shorter than by default: they grew for the first hour of a run. Dask makes workers return every freed array to
the system at once (MALLOC_TRIM_THRESHOLD_). That costs 15% of a tile's time in page faults, so this variable
is left out of their environment."""
SILENT_S = 300.0
"""How long a worker may be silent beyond the time limit of a tile (s)."""


def settings(cluster: Cluster, dashboard: bool) -> dict[str, Any]:
    """Return the Dask settings of scheduler and workers."""
    # A worker is silent while a library blocks the interpreter. By default Dask takes it for dead after
    # 5 minutes. If it hangs, the time limit of a tile ends it.
    values = SETTINGS | {"distributed.scheduler.worker-ttl": f"{cluster.tile_timeout_s + SILENT_S:.0f} s"}
    if cluster.kind == "local":
        # A dead worker is started again on this machine. By default Dask looks for it 15 s after each death,
        # and gives it up if it has died a second time and is just being started.
        values["distributed.deploy.lost-worker-timeout"] = "1000 d"
    # Web pages are turned off, because they need no certificate.
    values["distributed.worker.http.routes"] = []
    if not dashboard:
        values["distributed.scheduler.http.routes"] = []
    return values


def web_address(dashboard: bool) -> str:
    """Return the address of the scheduler's web pages: on this machine only, as they need no password."""
    return f"127.0.0.1:{8787 if dashboard else 0}"


def environment(cluster: Cluster, dashboard: bool) -> dict[str, str]:
    """Return the environment of workers."""
    values = settings(cluster, dashboard).items()
    names = {key: key.replace(".", "__").replace("-", "_").upper() for key, _ in values}
    return OF_WORKERS | {f"DASK_{names[key]}": str(value) for key, value in values}


def certificates(cluster: Cluster) -> Any:
    """Return new certificates for the connections of a cluster, None with ``security: none``."""
    return Security.temporary() if cluster.security == "tls" else None


def available_bytes(mount: Path = MOUNT, own: Path = OWN) -> int:
    """Return the memory that this process and its workers may use together.

    Dask knows the memory of the machine, the container and the limits of the process. It does not know the
    limits of a systemd unit or of a SLURM job (`group_limits`, with the same parameters).
    """
    return min([int(MEMORY_LIMIT), *group_limits(mount, own)])


def load_jobqueue() -> Any:
    """Return the module dask_jobqueue."""
    interrupt = signal.getsignal(signal.SIGINT)
    try:
        return importlib.import_module("dask_jobqueue")
    except ImportError as error:
        raise ConfigError(
            f"cluster.kind slurm needs dask-jobqueue: pip install 'flexroad[slurm]' ({error})"
        ) from error
    finally:
        # This import lets Ctrl-C exit with code 0.
        signal.signal(signal.SIGINT, interrupt)


@contextlib.contextmanager
def opened(make: Callable[[], T]) -> Iterator[T]:
    """Construct a Dask cluster or client; close it at the end, even if an interrupt comes while it starts.

    Dask could not close an object whose constructor was interrupted, so a thread calls it. This thread, all
    threads that Dask starts, and their processes get no SIGINT and no SIGHUP. A terminal sends both to all
    processes of a command. This process ends the others, which would only print tracebacks.
    """
    with ThreadPoolExecutor(1, initializer=_block_signals) as pool, contextlib.ExitStack() as stack:
        # Dask also sets the variables of workers in this process; later processes must not inherit them.
        stack.callback(_restore, {name: os.environ.get(name) for name in OF_WORKERS})
        made = pool.submit(make)
        stack.callback(_close, made)
        yield made.result()


def _restore(variables: Mapping[str, str | None]) -> None:
    for name, value in variables.items():
        if value is None:
            os.environ.pop(name, None)
        else:
            os.environ[name] = value


def _block_signals() -> None:
    # Dask would start the resource tracker before it sets this environment.
    os.environ.update(OF_WORKERS)
    # The tracker is started now, because its start would allow the signals again.
    resource_tracker.ensure_running()
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGHUP})


def _close(made: Future[Any]) -> None:
    if made.exception() is None:
        made.result().close()


def start_workers(opened: Any, number: int) -> None:
    """Start the missing workers, or jobs, of a Dask `SpecCluster` with a number of workers.

    Unlike ``scale`` it returns when they are started, and raises the error of a start.
    """
    while len(opened.worker_spec) < number:
        opened.worker_spec.update(opened.new_worker_spec())
    opened.sync(_started, opened)


async def _started(opened: Any) -> None:
    # An interrupt cancels only the wait: Dask could not close a cluster whose start was cancelled.
    await asyncio.shield(opened._correct_state())
