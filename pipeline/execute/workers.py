"""What is asked of a worker before it gets a tile, and what is done to it: imported by workers themselves."""

from __future__ import annotations

import asyncio
import importlib.metadata
import os
import platform
import signal
import sys
from collections.abc import Callable, Mapping
from threading import Lock, local
from typing import Any

from distributed import WorkerPlugin

from flexroad.pipeline import ONE_THREAD
from flexroad.pipeline.execute.executor import J, R

PICKLING = ("python", "dask", "distributed", "cloudpickle")
"""What must be alike for messages to be understood; also on the scheduler."""
RESULTS = ("flexroad", "numpy", "scipy", "numba", "rasterio", "startinpy", "torch")
"""What must be alike for tiles to come out alike."""

_here = local()
"""What is known of the thread that does a job."""


class WorkerCheck(WorkerPlugin):  # type: ignore[misc]
    """Pins a worker's threads and, before its first tile, compares versions and tries the store.

    Parameters
    ----------
    versions : mapping
        Of the client, as `versions` gives them.
    probe : callable, optional
        Raises OSError where no work can be done.
    deaf : bool
        Leave Ctrl-C to the client: a terminal sends it to all processes of the command, and workers would
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
        """Prepare a worker of now, or one that joins later."""
        self.address: str = worker.address
        self._lock = Lock()
        self._fault: str | None = None
        if self.ignore_sigint:
            signal.signal(signal.SIGINT, signal.SIG_IGN)
        pin_threads()

    @property
    def fault(self) -> str:
        """Why the worker must not work, or nothing; found out once."""
        with self._lock:
            if self._fault is None:
                self._fault = self._find_fault()
            return self._fault

    def _find_fault(self) -> str:
        other = difference(versions(), self.versions)
        if other:
            return unlike(f"worker {self.address}", other)
        try:
            if self.probe:
                self.probe()
        except OSError as error:
            where = f"{error.filename}: " if error.filename else ""
            return (
                f"worker {self.address} cannot use the store: {where}{error.strerror or error}; "
                "mount it there under the same path and let the worker write it"
            )
        return ""


def work(function: Callable[[J], R], job: J) -> R:
    """Do one job on a worker that is fit to."""
    if not hasattr(_here, "pinned"):
        # Some libraries count by calling thread. Once is enough: what is loaded later reads the environment.
        pin_threads()
        _here.pinned = True
    return function(job)


async def find_fault(guard: str, dask_worker: Any) -> str:
    """Return why a worker must not work, or nothing."""
    watch: WorkerCheck = dask_worker.plugins[guard]
    return await asyncio.to_thread(lambda: watch.fault)


def pin_threads() -> None:
    """Let this thread and the libraries it calls compute on one core: the other cores do other tiles."""
    # In time for what is loaded later; what is loaded already must be told.
    os.environ.update(ONE_THREAD)
    from threadpoolctl import threadpool_limits

    threadpool_limits(1)
    if "torch" in sys.modules:
        sys.modules["torch"].set_num_threads(1)
    if "numba" in sys.modules:
        sys.modules["numba"].set_num_threads(1)


def versions() -> dict[str, str]:
    """Return the versions here of what decides whether messages are understood and tiles come out alike."""
    found = {"python": platform.python_version()}
    for package in (*PICKLING[1:], *RESULTS):
        try:
            found[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            found[package] = "missing"
    return found


def difference(there: Mapping[str, str], here: Mapping[str, str]) -> str:
    """Return in words which versions differ, or nothing.

    Of Python the minor version counts; a build's local label (``+cpu``) does not.
    """
    unlike = [name for name in there if _plain(name, there[name]) != _plain(name, here[name])]
    return ", ".join(f"{name} is {there[name]} there and {here[name]} here" for name in unlike)


def unlike(who: str, other: str) -> str:
    """Return the line about a process with other versions."""
    return f"{who}: {other}; install the same there, best with the same constraints.txt"


def _plain(name: str, version: str) -> str:
    return ".".join(version.split(".")[:2]) if name == "python" else version.split("+")[0]
