"""Dask scheduler and workers as separate processes on loopback, which tests may kill."""

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path


class Processes:
    """A scheduler and workers, each started by the ``dask`` command."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.started: list[subprocess.Popen] = []
        self.address = ""

    def scheduler(self) -> subprocess.Popen:
        """Start a scheduler, at the previous address if any; its settings differ from the client's."""
        file = self.folder / "scheduler.json"
        file.unlink(missing_ok=True)
        port = self.address.rpartition(":")[2] or "0"
        options = ["--host", "127.0.0.1", "--port", port, "--scheduler-file", file, "--no-dashboard"]
        process = self._start("scheduler", *options, DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES="7")
        self.address = until(lambda: file.exists() and json.loads(file.read_text() or "{}")).get("address")
        return process

    def worker(self, *options: str, before: tuple[str, ...] = (), **env: str) -> subprocess.Popen:
        """Start a worker process with these options and environment variables, by the command ``before``."""
        options = ("--nthreads", "1", "--no-dashboard", "--local-directory", str(self.folder), *options)
        return self._start("worker", self.address, *options, before=before, **env)

    def end(self) -> None:
        """Kill all processes."""
        for process in self.started:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()

    def _start(self, *words, before: tuple[str, ...] = (), **env: str) -> subprocess.Popen:
        command = [*before, sys.executable, "-m", "dask", *map(str, words)]
        with (self.folder / "output.txt").open("a") as output:
            process = subprocess.Popen(
                command, env={**os.environ, **env}, stdout=output, stderr=output, start_new_session=True
            )
        self.started.append(process)
        return process


def until(condition, seconds: float = 180):
    """Call a function until its result is true; return the result."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        result = condition()
        if result:
            return result
        time.sleep(0.02)
    raise AssertionError(f"condition not met within {seconds:g} s")


def wait_for(address: str, workers: int) -> None:
    """Wait until a scheduler has this number of workers."""
    from distributed import Client

    with Client(address, set_as_default=False) as client:
        client.wait_for_workers(workers, 60)
