"""Workers of a Dask cluster: their setup, their check before the first tile, and which of them may do jobs.

Objects for the scheduler are pickled by value, so that the scheduler needs no flexroad.
"""

from __future__ import annotations

import contextlib
import faulthandler
import hashlib
import importlib.metadata
import os
import platform
import socket
import sys
import time
import uuid
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cache
from importlib.resources import files
from pathlib import Path
from threading import Lock, local
from typing import Any

from distributed import Client, SchedulerPlugin, WorkerPlugin, get_worker
from distributed.protocol.pickle import dumps, loads
from threadpoolctl import threadpool_limits

from flexroad.catalog.text import Notify, one_line
from flexroad.pipeline import ONE_THREAD
from flexroad.pipeline.errors import ClusterLost, ConfigError
from flexroad.pipeline.execute.executor import J, Probe, R

PICKLING = ("python", "dask", "distributed", "cloudpickle")
"""Packages whose versions must be equal on client, workers and scheduler, to exchange objects."""
RESULTS = ("flexroad", "numpy", "scipy", "numba", "rasterio", "startinpy", "torch")
"""Packages whose versions must be equal on all workers, for equal results."""
CODE = "the code of flexroad"
"""Name of the checksum of the installed program among the versions."""
INSTALLED = Path(str(files("flexroad")))
"""Folder of the package."""
SAME = "install the same there, best with the same constraints.txt"
"""Remedy for other versions."""

_thread = local()
"""Per thread: ``pinned`` is set once its libraries are limited to one thread."""


class WorkerCheck(WorkerPlugin):  # type: ignore[misc]
    """Limits a worker to one thread; before its first job, compares versions and takes the client's probe."""

    def __init__(self, versions: Mapping[str, str], probe: Probe | None = None) -> None:
        self.versions = dict(versions)
        # The probe is pickled, so that a worker with another program reports that before it needs its class.
        self.probe = dumps(probe)

    def setup(self, worker: Any) -> None:
        """Prepare the worker; called for workers that join later, too."""
        self._lock = Lock()
        self._accepted = False
        self._answer: tuple[str, Any] | None = None
        pin_threads()

    def admit(self, packed: bytes, accepted: bool) -> tuple[str, Any]:
        """Check the worker, once, with its first job.

        - `packed`: the pickled call of `work`.
        - `accepted`: whether the client has accepted the proof of this worker.
        - `fault`: why the worker cannot do the jobs, empty if it can.
        - `proof`: the proof that the client must accept before the worker does a job, None if it may do jobs.
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
    threadpool_limits(1)
    if "torch" in sys.modules:
        sys.modules["torch"].set_num_threads(1)
    if "numba" in sys.modules:
        sys.modules["numba"].set_num_threads(1)


def versions() -> dict[str, str]:
    """Return versions of Python and of the packages in `PICKLING` and `RESULTS`, and `checksum_of_code`.

    The version of a package that is not installed is "missing".
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

    It is the same for a wheel and for the checkout from which the wheel was made.
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
    """Return a text with the versions that differ; empty if all are equal.

    For Python only major and minor version are compared; a local label (``+cpu``) is ignored.
    """
    different = [name for name in there if _comparable(name, there[name]) != _comparable(name, here[name])]
    return ", ".join(f"{name} is {there[name]} there and {here[name]} here" for name in different)


def _comparable(name: str, version: str) -> str:
    return ".".join(version.split(".")[:2]) if name == "python" else version.split("+")[0]


@dataclass
class Admission:
    """Accepts the proofs of workers, and reports which workers are left out."""

    probe: Probe | None
    """The probe of the `WorkerCheck`."""
    notify: Notify
    left_out: dict[str, str] = field(default_factory=dict)
    """Why a worker gets no jobs, in one line, by its address."""
    _accepted: dict[str, Any] = field(default_factory=dict)
    """Accepted proofs by worker address."""
    _told: set[tuple[str, str]] = field(default_factory=set)
    """Host and reason of the workers left out: one line for all workers of a host."""

    def able(self, present: Mapping[str, int]) -> dict[str, int]:
        """Return the present workers, by address, without the workers that are left out."""
        # A new worker may get the address of a worker that has ended.
        self._accepted = {address: proof for address, proof in self._accepted.items() if address in present}
        self.left_out = {address: line for address, line in self.left_out.items() if address in present}
        return {address: n for address, n in present.items() if address not in self.left_out}

    def accepts(self, address: str, host: str, fault: str, proof: Any) -> bool:
        """Return whether a worker may do jobs, by what `WorkerCheck.admit` returned; else leave it out."""
        if address in self.left_out:
            # Other jobs of this worker bring the same fault or proof.
            return False
        if self.probe and proof is not None and self._accepted.get(address) != proof:
            try:
                self.probe.accept(proof)
                self._accepted[address] = proof
            except OSError as error:
                fault = reason_of(error)
        if fault:
            self.left_out[address] = f"worker {address} on {host} is left out: {fault}"
            if (host, fault) not in self._told:
                self._told.add((host, fault))
                self.notify(self.left_out[address])
        return not fault


def check_workers(client: Client, cluster: str, probe: Probe | None) -> str:
    """Compare versions for pickling, and register plugins; return the name of the `WorkerCheck`."""
    here = versions()
    name = uuid.uuid4().hex[:8]
    try:
        _compare(client, here)
        client.register_plugin(retry_blocker(client.id, name), name=f"flexroad-{name}")
        _register(client, WorkerCheck(here, probe), name)
    except ConfigError:
        raise
    except OSError as error:
        raise ClusterLost(f"{cluster} went away before its first tile: {error}") from error
    except Exception as error:
        # Unpickling on the cluster may raise any type of error.
        raise ConfigError(
            f"{cluster} cannot load flexroad ({one_line(error)}); install it for the workers, and let the "
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
    """Compare the versions that Dask reports: with very different versions no plugin could be unpickled."""
    here = {name: here[name] for name in PICKLING}
    reported = client.get_versions(packages=list(PICKLING[1:]))
    _compare_process("the scheduler", reported["scheduler"], here)
    for address, worker in reported["workers"].items():
        _compare_process(f"worker {address}", worker, here)


def _compare_process(name: str, reported: Any, here: dict[str, str]) -> None:
    there = {package: reported["packages"].get(package) or "missing" for package in here}
    there["python"] = ".".join(reported["host"]["python"].split(".")[:3])
    different = difference(there, here)
    if different:
        raise ConfigError(f"{name}: {different}; {SAME}")


def task_function() -> Callable[[bytes, str, bool], tuple[str, str, str, Any, Any]]:
    """Return the function of every task: it unpickles a call and runs it if the worker passed its check.

    Its arguments are the pickled call, the name of the `WorkerCheck` and whether the client has accepted the
    worker. It returns address and host of the worker, the result of `WorkerCheck.admit`, and the result of
    the call, or None. A scheduler unpickles the tasks that it receives; a pickled call stays bytes there.
    """

    def run_task(packed: bytes, check: str, accepted: bool) -> tuple[str, str, str, Any, Any]:
        worker = get_worker()
        address, host = worker.address, socket.gethostname()
        admit = getattr(worker.plugins.get(check), "admit", None)
        if admit is None:
            # An older version may have another `WorkerCheck`.
            return address, host, "it cannot load this version of flexroad; install it there", None, None
        fault, proof = admit(packed, accepted)
        if fault or proof is not None:
            return address, host, fault, proof, None
        work, function, job = loads(packed)
        return address, host, "", None, work(function, job)

    return run_task


def retry_blocker(client_id: str, check: str) -> SchedulerPlugin:
    """Return a scheduler plugin that fails a client's tasks at the first death of their worker.

    By default a scheduler retries such tasks on other workers (setting
    ``distributed.scheduler.allowed-failures``): a tile that kills its worker would kill other workers, too.
    Tasks of other clients are not affected. When the client disconnects or is killed, the plugins are
    removed.
    """

    class RetryBlocker(SchedulerPlugin):  # type: ignore[misc]
        def update_graph(self, scheduler: Any, *, client: str, tasks: list[Any], **_: Any) -> None:
            if client == client_id:
                for key in tasks:
                    # With this number one more death of a worker fails the task.
                    scheduler.tasks[key].suspicious = scheduler.allowed_failures

        def remove_client(self, scheduler: Any, client: str) -> None:
            if client == client_id:
                scheduler.worker_plugins.pop(check, None)
                scheduler.plugins.pop(f"flexroad-{check}", None)

    return RetryBlocker()
