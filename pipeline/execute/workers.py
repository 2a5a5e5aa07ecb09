"""Setup and check of a worker before its first tile; runs in the worker processes."""

from __future__ import annotations

import contextlib
import faulthandler
import hashlib
import importlib.metadata
import os
import platform
import sys
from collections.abc import Callable, Iterator, Mapping
from functools import cache
from importlib.resources import files
from pathlib import Path
from threading import Lock, local
from typing import Any

from distributed import WorkerPlugin
from distributed.protocol.pickle import dumps, loads

from flexroad.pipeline import ONE_THREAD
from flexroad.pipeline.execute.executor import J, Probe, R

PICKLING = ("python", "dask", "distributed", "cloudpickle")
"""Packages whose versions must be equal for processes to exchange objects; also on the scheduler."""
RESULTS = ("flexroad", "numpy", "scipy", "numba", "rasterio", "startinpy", "torch")
"""Packages whose versions must be equal for tiles to have equal results."""
CODE = "the code of flexroad"
"""Name of the checksum of the installed program among the versions."""
INSTALLED = Path(str(files("flexroad")))
"""Folder of the package."""
SAME = "install the same there, best with the same constraints.txt"
"""Remedy for other versions."""

_thread = local()
"""Per thread: ``pinned`` is set once its libraries are limited to one thread."""


class WorkerCheck(WorkerPlugin):  # type: ignore[misc]
    """Limits a worker to one thread; before its first job, compares versions and takes the client's probe.

    Parameters
    ----------
    versions : mapping
        Versions of the client, from `versions`.
    probe : Probe, optional
        Check of what the jobs need.
    """

    def __init__(self, versions: Mapping[str, str], probe: Probe | None = None) -> None:
        self.versions = dict(versions)
        # Pickled, so that a worker with another program says so before it looks for the class of the probe.
        self.probe = dumps(probe)

    def setup(self, worker: Any) -> None:
        """Prepare the worker; called for workers that join later, too."""
        self._lock = Lock()
        self._accepted = False
        self._answer: tuple[str, Any] | None = None
        pin_threads()

    def admit(self, packed: bytes, accepted: bool) -> tuple[str, Any]:
        """Check the worker, once, with its first job.

        Parameters
        ----------
        packed : bytes
            The pickled call of `work`.
        accepted : bool
            Whether the client has accepted the proof of this worker.

        Returns
        -------
        fault : str
            Why the worker cannot do the jobs, empty if it can.
        proof : object
            What the client has to accept before the worker does a job, None if it may do jobs.
        """
        with self._lock:
            self._accepted = self._accepted or accepted
            if self._accepted:
                return "", None
            if self._answer is None:
                self._answer = self._check(packed)
            return self._answer

    def _check(self, packed: bytes) -> tuple[str, Any]:
        different = difference(versions(), self.versions)
        if different:
            return f"{different}; {SAME}", None
        probe: Probe | None = loads(self.probe)
        _, _, job = loads(packed)
        try:
            return "", probe.answer(job) if probe else None
        except OSError as error:
            return reason_of(error), None


def reason_of(error: OSError) -> str:
    """Return file and reason of an error in one line."""
    file = f"{error.filename}: " if error.filename else ""
    return f"{file}{error.strerror or error}"


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
    """Return versions of Python and of the packages in `PICKLING` and `RESULTS`, and `checksum_of_code`.

    That of a package that is not installed is "missing".
    """
    installed = {"python": platform.python_version(), CODE: checksum_of_code()}
    for package in (*PICKLING[1:], *RESULTS):
        try:
            installed[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            installed[package] = "missing"
    return installed


@cache
def checksum_of_code(root: Path = INSTALLED) -> str:
    """Return 12 hexadecimal digits of the SHA-256 of names and contents of flexroad's Python files.

    It is the same for a wheel and for the checkout that the wheel was made of.
    """
    # The folders of a checkout are links.
    folders = os.walk(root, followlinks=True)
    files = sorted(Path(folder, name) for folder, _, names in folders for name in names)
    digest = hashlib.sha256()
    for file in files:
        if file.suffix == ".py":
            data = file.read_bytes()
            digest.update(f"{file.relative_to(root).as_posix()} {len(data)}\n".encode() + data)
    return digest.hexdigest()[:12]


def difference(there: Mapping[str, str], here: Mapping[str, str]) -> str:
    """Return a text with the versions that differ; empty if none do.

    Of Python only major and minor version are compared; a local label (``+cpu``) is ignored.
    """
    different = [name for name in there if _comparable(name, there[name]) != _comparable(name, here[name])]
    return ", ".join(f"{name} is {there[name]} there and {here[name]} here" for name in different)


def version_error(process: str, different: str) -> str:
    """Return the error message about a process with other versions."""
    return f"{process}: {different}; {SAME}"


def _comparable(name: str, version: str) -> str:
    return ".".join(version.split(".")[:2]) if name == "python" else version.split("+")[0]
