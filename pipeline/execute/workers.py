"""Setup and check of a worker before its first tile; runs in the worker processes."""

from __future__ import annotations

import asyncio
import contextlib
import faulthandler
import importlib.metadata
import os
import platform
import signal
import sys
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from threading import Lock, local
from typing import Any

from distributed import WorkerPlugin

from flexroad.pipeline import ONE_THREAD
from flexroad.pipeline.execute.executor import J, R

PICKLING = ("python", "dask", "distributed", "cloudpickle")
"""Packages whose versions must be equal for processes to exchange objects; also on the scheduler."""
RESULTS = ("flexroad", "numpy", "scipy", "numba", "rasterio", "startinpy", "torch")
"""Packages whose versions must be equal for tiles to have equal results."""

_thread = local()
"""Per thread: ``pinned`` is set once its libraries are limited to one thread."""


class WorkerCheck(WorkerPlugin):  # type: ignore[misc]
    """Limits a worker to one thread; before its first tile, compares versions and runs a probe.

    Parameters
    ----------
    versions : mapping
        Versions of the client, from `versions`.
    probe : callable, optional
        Raises OSError if the process cannot do the work.
    ignore_sigint : bool
        Ignore Ctrl-C in the worker. A terminal sends it to all processes of the command, and workers would
        only print tracebacks.
    """

    def __init__(
        self,
        versions: Mapping[str, str],
        probe: Callable[[], None] | None = None,
        ignore_sigint: bool = False,
    ) -> None:
        self.versions = dict(versions)
        self.probe = probe
        self.ignore_sigint = ignore_sigint

    def setup(self, worker: Any) -> None:
        """Prepare the worker; called for workers that join later, too."""
        self.address: str = worker.address
        self._lock = Lock()
        self._fault: str | None = None
        if self.ignore_sigint:
            signal.signal(signal.SIGINT, signal.SIG_IGN)
        pin_threads()

    @property
    def fault(self) -> str:
        """Error message if the worker cannot do the work, else empty; computed once."""
        with self._lock:
            if self._fault is None:
                self._fault = self._find_fault()
            return self._fault

    def _find_fault(self) -> str:
        different = difference(versions(), self.versions)
        if different:
            return version_error(f"worker {self.address}", different)
        try:
            if self.probe:
                self.probe()
        except OSError as error:
            file = f"{error.filename}: " if error.filename else ""
            return (
                f"worker {self.address} cannot use the store: {file}{error.strerror or error}; "
                "mount it there under the same path and make it writable for the worker"
            )
        return ""


def work(function: Callable[[J], R], job: J, limit_s: float) -> R:
    """Do one job on a worker that passed its check; the process ends if it takes longer than ``limit_s``."""
    if not hasattr(_thread, "pinned"):
        # Some libraries have a limit per calling thread. Libraries loaded later read the environment.
        pin_threads()
        _thread.pinned = True
    with _time_limit(limit_s):
        return function(job)


@contextlib.contextmanager
def _time_limit(limit_s: float) -> Iterator[None]:
    """End the process if the block takes longer (s).

    The timer of faulthandler also ends a process that hangs in a library without giving other threads a
    turn. There is one per process: on a worker with several threads it covers the last job started.
    """
    with Path(os.devnull).open("w") as nowhere:
        faulthandler.dump_traceback_later(limit_s, exit=True, file=nowhere)
        try:
            yield
        finally:
            faulthandler.cancel_dump_traceback_later()


async def find_fault(check: str, dask_worker: Any) -> str:
    """Return an error message if the worker cannot do the work, else an empty string."""
    plugin: WorkerCheck = dask_worker.plugins[check]
    return await asyncio.to_thread(lambda: plugin.fault)


def pin_threads() -> None:
    """Limit the libraries that this thread calls to one core: the other cores compute other tiles."""
    # The environment sets libraries that are loaded later; loaded ones are set by their own functions.
    os.environ.update(ONE_THREAD)
    from threadpoolctl import threadpool_limits

    threadpool_limits(1)
    if "torch" in sys.modules:
        sys.modules["torch"].set_num_threads(1)
    if "numba" in sys.modules:
        sys.modules["numba"].set_num_threads(1)


def versions() -> dict[str, str]:
    """Return the versions of Python and the packages in `PICKLING` and `RESULTS`; "missing" if absent."""
    installed = {"python": platform.python_version()}
    for package in (*PICKLING[1:], *RESULTS):
        try:
            installed[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            installed[package] = "missing"
    return installed


def difference(there: Mapping[str, str], here: Mapping[str, str]) -> str:
    """Return a text with the versions that differ; empty if none do.

    Of Python only major and minor version are compared; a local label (``+cpu``) is ignored.
    """
    different = [name for name in there if _comparable(name, there[name]) != _comparable(name, here[name])]
    return ", ".join(f"{name} is {there[name]} there and {here[name]} here" for name in different)


def version_error(process: str, different: str) -> str:
    """Return the error message about a process with other versions."""
    return f"{process}: {different}; install the same there, best with the same constraints.txt"


def _comparable(name: str, version: str) -> str:
    return ".".join(version.split(".")[:2]) if name == "python" else version.split("+")[0]
