"""A Dask cluster of real processes on loopback, for tests to kill."""

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path


class Processes:
    """A scheduler and workers, each a process started by Dask's own commands."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.started: list[subprocess.Popen] = []
        self.address = ""

    def scheduler(self) -> subprocess.Popen:
        """Start one, where it was before if there was one; its settings are others than one's own."""
        file = self.folder / "scheduler.json"
        file.unlink(missing_ok=True)
        port = self.address.rpartition(":")[2] or "0"
        options = ["--host", "127.0.0.1", "--port", port, "--scheduler-file", file, "--no-dashboard"]
        process = self._start("scheduler", *options, DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES="7")
        self.address = until(lambda: file.exists() and json.loads(file.read_text() or "{}")).get("address")
        return process

    def worker(self, *options: str, **env: str) -> subprocess.Popen:
        options = ("--nthreads", "1", "--no-dashboard", "--local-directory", str(self.folder), *options)
        return self._start("worker", self.address, *options, **env)

    def end(self) -> None:
        for process in self.started:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()

    def _start(self, *words, **env: str) -> subprocess.Popen:
        command = [sys.executable, "-m", "dask", *map(str, words)]
        with (self.folder / "said.txt").open("a") as said:
            process = subprocess.Popen(
                command, env={**os.environ, **env}, stdout=said, stderr=said, start_new_session=True
            )
        self.started.append(process)
        return process


def until(condition, seconds: float = 60):
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        found = condition()
        if found:
            return found
        time.sleep(0.02)
    raise AssertionError("waited in vain")


def wait_for(address: str, workers: int) -> None:
    from distributed import Client

    with Client(address, set_as_default=False) as client:
        client.wait_for_workers(workers, 60)
