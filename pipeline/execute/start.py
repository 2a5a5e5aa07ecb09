"""Start of a cluster from this process."""

from __future__ import annotations

import asyncio
import contextlib
import importlib
import signal
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from multiprocessing import resource_tracker
from typing import Any, TypeVar

from flexroad.pipeline.errors import ConfigError

T = TypeVar("T")
PACKAGES = {
    "slurm": ("dask_jobqueue", "dask-jobqueue"),
    "kubernetes": ("dask_kubernetes.operator", "dask-kubernetes"),
}
"""Module and package by kind of cluster."""


def extra(kind: str) -> Any:
    """Return the module of a kind of cluster.

    Raises
    ------
    ConfigError
        If its package is not installed.
    """
    module, package = PACKAGES[kind]
    interrupt = signal.getsignal(signal.SIGINT)
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise ConfigError(
            f"cluster.kind {kind} needs {package}: pip install 'flexroad[{kind}]' ({error})"
        ) from error
    finally:
        # The import of dask_jobqueue lets Ctrl-C exit with code 0.
        signal.signal(signal.SIGINT, interrupt)


@contextlib.contextmanager
def opened(make: Callable[[], T]) -> Iterator[T]:
    """Construct a Dask cluster or client; close it at the end, also if an interrupt comes while it starts.

    Dask could not close an object whose constructor was interrupted: it is called in a thread. That thread,
    all threads that Dask starts, and so their processes get no SIGINT and no SIGHUP. A terminal sends both to
    all processes of a command: this one ends the others, which would only print tracebacks.
    """
    with ThreadPoolExecutor(1, initializer=_block_signals) as pool, contextlib.ExitStack() as stack:
        made = pool.submit(make)
        stack.callback(_close, made)
        yield made.result()


def _block_signals() -> None:
    # Its start would allow the signals again.
    resource_tracker.ensure_running()
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGHUP})


def _close(made: Future[Any]) -> None:
    if made.exception() is None:
        made.result().close()


def start_workers(opened: Any, number: int) -> None:
    """Start the missing ones of a number of workers of a Dask `SpecCluster`, or its jobs.

    Unlike ``scale`` it returns when they are started, and raises the error of a start.
    """
    while len(opened.worker_spec) < number:
        opened.worker_spec.update(opened.new_worker_spec())
    opened.sync(_started, opened)


async def _started(opened: Any) -> None:
    # An interrupt cancels the wait alone: Dask could not close a cluster whose start was cancelled.
    await asyncio.shield(opened._correct_state())


def one_line(error: Exception) -> str:
    """Return the message of an error in one line."""
    return " ".join(str(error).split()) or repr(error)
