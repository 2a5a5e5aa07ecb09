"""Workers as jobs of SLURM. A job that ends (walltime, cancelled, lost node) is submitted again."""

from __future__ import annotations

import asyncio
import contextlib
import os
import shlex
import shutil
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from datetime import timedelta
from functools import partial
from pathlib import Path
from typing import Any

from distributed.core import Status
from distributed.security import Security
from tornado.ioloop import PeriodicCallback

from flexroad.catalog.text import Notify, count
from flexroad.pipeline.config.models import DEFAULT_MEMORY_BYTES, Cluster
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.execute.start import (
    certificates,
    environment,
    load_jobqueue,
    opened,
    start_workers,
    web_address,
)

CHECK_S = 15.0
"""Interval between requests to SLURM about the jobs (s)."""
TRIES = 3
"""A job is given up if it and its replacements end this many times before a worker of them connects."""
NAME = "flexroad"
"""Name of the jobs; the names of the files with their output begin with it."""


@dataclass(eq=False)
class SlurmJobs:
    """The jobs of a cluster. Jobs that SLURM no longer has are submitted again.

    Dask itself does so only for jobs of one worker (dask-jobqueue#611), and not for jobs that end while they
    wait. It takes a worker that is missing for 15 s for a lost job, even if its nanny is replacing it.
    """

    cluster: Any
    """The `dask_jobqueue.SLURMCluster` that the jobs belong to."""
    folder: Path
    """Folder of the output of the jobs, for messages."""
    notify: Notify
    failures: Counter[str] = field(default_factory=Counter)
    """Number of ended jobs since a worker last connected, by the job's name in Dask."""

    @property
    def given_up(self) -> bool:
        """Whether no job is left to be submitted again."""
        return not self.cluster.worker_spec

    def start(self, number: int) -> None:
        """Submit jobs."""
        try:
            start_workers(self.cluster, number)
        except RuntimeError as error:
            if not any(job.job_id for job in self.cluster.workers.values()):
                raise ConfigError(
                    f"cluster.kind slurm: sbatch refuses the jobs: {_answer(error)}; correct the options "
                    "of the cluster"
                ) from error
            self.notify(f"sbatch refuses a job: {_answer(error)}")

    @contextlib.contextmanager
    def watched(self) -> Iterator[None]:
        """Look for ended jobs during the block."""
        timer = PeriodicCallback(self.check, CHECK_S * 1000)
        self.cluster.loop.add_callback(timer.start)
        try:
            yield
        finally:
            self.cluster.loop.add_callback(timer.stop)

    async def check(self) -> None:
        """Submit the jobs again that SLURM no longer has."""
        # The jobs are listed before the request: its answer does not have jobs that are submitted meanwhile.
        jobs = dict(self.cluster.workers)
        listed = await _listed_jobs()
        if listed is None:
            return
        for worker in self.cluster.scheduler_info["workers"].values():
            # If a job has several workers, each has its number after the name of the job.
            name = worker["name"]
            self.failures.pop(name if name in self.cluster.worker_spec else name.rpartition("-")[0], None)
        ended = [name for name, job in jobs.items() if job.job_id not in listed]
        for name in ended:
            self.cluster.workers.pop(name).status = Status.closed
            self.failures[name] += 1
            if self.failures[name] >= TRIES:
                self.cluster.worker_spec.pop(name, None)
        if ended:
            await self._replace(ended)

    async def _replace(self, ended: list[str]) -> None:
        left = [name for name in ended if name in self.cluster.worker_spec]
        if given_up := len(ended) - len(left):
            self.notify(
                f"{count(given_up, 'SLURM job')} given up: {TRIES} in a row ended before a worker connected; "
                f"{self.folder} has their output"
            )
        if left:
            self.notify(f"{count(len(left), 'SLURM job')} ended; submitted again")
            try:
                await self.cluster._correct_state()
            except RuntimeError as error:
                self.notify(f"sbatch refuses a job: {_answer(error)}")


@contextlib.contextmanager
def slurm(cluster: Cluster, dashboard: bool, logs: Path | None, notify: Notify) -> Iterator[SlurmJobs]:
    """Open a cluster of SLURM jobs, whose output is written to the folder ``logs``."""
    jobqueue = load_jobqueue()
    for program in ("sbatch", "squeue", "scancel"):
        if shutil.which(program) is None:
            raise ConfigError(
                f"cluster.kind slurm: there is no {program} here; run this on a login node of the cluster, "
                "with the SLURM client installed, or set `cluster: local`"
            )
    with contextlib.ExitStack() as stack:
        folder = stack.enter_context(_shared_folder(logs))
        security = stack.enter_context(_certificates(cluster, folder))
        options = slurm_options(cluster, dashboard, folder) | {"security": security}
        make = partial(jobqueue.SLURMCluster, job_cls=_job_class(jobqueue), **options)
        jobs = SlurmJobs(stack.enter_context(opened(make)), folder, notify)
        jobs.start(-(-(cluster.workers or 1) // cluster.per_job))
        stack.enter_context(jobs.watched())
        yield jobs


def slurm_options(cluster: Cluster, dashboard: bool, folder: Path) -> dict[str, Any]:
    """Return the options of ``SLURMCluster``: jobs of ``per_job`` workers, one thread and core each."""
    walltime = timedelta(hours=cluster.walltime_h)
    hours, minutes = divmod(round(walltime.total_seconds() / 60), 60)
    # A worker that closes before SLURM kills it returns its tiles to the scheduler.
    lifetime = max(walltime - timedelta(minutes=5), walltime / 2)
    stagger = min(timedelta(minutes=1), lifetime / 2)
    exports = [
        f"export {name}={shlex.quote(value)}" for name, value in environment(cluster, dashboard).items()
    ]
    return {
        "queue": cluster.queue,
        "cores": cluster.per_job,
        "processes": cluster.per_job,
        "memory": f"{(cluster.memory or DEFAULT_MEMORY_BYTES) * cluster.per_job} B",
        "walltime": f"{hours:02}:{minutes:02}:00",
        "job_extra_directives": list(cluster.job_extra),
        "job_script_prologue": [*exports, *cluster.prologue],
        "worker_extra_args": [
            "--no-dashboard",
            "--lifetime",
            f"{lifetime.total_seconds():.0f}s",
            "--lifetime-stagger",
            f"{stagger.total_seconds():.0f}s",
        ],
        "python": sys.executable,
        "job_name": NAME,
        "log_directory": str(folder),
        "interface": cluster.interface,
        "scheduler_options": {"dashboard": dashboard, "dashboard_address": web_address(dashboard)},
        "silence_logs": "critical",
    }


@contextlib.contextmanager
def _shared_folder(logs: Path | None) -> Iterator[Path]:
    """Yield a folder for the output of jobs and certificates, without the output of an earlier run.

    All machines share it: it is ``logs``, or a folder in the home folder that is removed at the end.
    """
    with contextlib.ExitStack() as stack:
        if logs is None:
            home = tempfile.TemporaryDirectory(
                prefix=f".{NAME}-", dir=Path.home(), ignore_cleanup_errors=True
            )
            logs = Path(stack.enter_context(home))
        if shlex.quote(str(logs)) != str(logs):
            raise ConfigError(
                f"cluster.kind slurm: dask-jobqueue cannot pass the path {str(logs)!r} to its jobs; choose a "
                "RUN without blanks, quotes and other special characters in its path"
            )
        logs.mkdir(exist_ok=True)
        for pattern in (f"{NAME}-*.out", f"{NAME}-*.err"):
            for path in logs.glob(pattern):
                path.unlink(missing_ok=True)
        yield logs


@contextlib.contextmanager
def _certificates(cluster: Cluster, folder: Path) -> Iterator[Security | None]:
    """Yield new certificates in files of a folder that only this user can read; it is removed at the end."""
    made = certificates(cluster)
    if made is None:
        yield None
        return
    private = folder / ".certificates"
    # A killed run may have left the folder.
    shutil.rmtree(private, ignore_errors=True)
    private.mkdir(mode=0o700)
    try:
        files = {}
        for name in Security.__slots__:
            if name.endswith(("_file", "_cert", "_key")):
                (private / name).write_text(getattr(made, name))
                files[name] = str(private / name)
        yield Security(require_encryption=True, **files)
    finally:
        shutil.rmtree(private, ignore_errors=True)


def _job_class(jobqueue: Any) -> Any:
    """Return a class of jobs that can be closed: Dask requires it at the end, dask-jobqueue never does it."""

    class Job(jobqueue.slurm.SLURMJob):  # type: ignore[misc]
        async def close(self) -> None:
            await super().close()
            self.status = Status.closed

    return Job


async def _listed_jobs() -> set[str] | None:
    """Return the ids of this user's jobs that wait or run, None if SLURM does not answer."""
    words = ["squeue", "--noheader", "--format=%A", f"--user={os.getuid()}"]
    # The user may have filters in the environment.
    plain = {name: value for name, value in os.environ.items() if not name.startswith("SQUEUE_")}
    pipe, nowhere = asyncio.subprocess.PIPE, asyncio.subprocess.DEVNULL
    asked = await asyncio.create_subprocess_exec(*words, env=plain, stdout=pipe, stderr=nowhere)
    answer, _ = await asked.communicate()
    return set(answer.decode().split()) if asked.returncode == 0 else None


def _answer(error: RuntimeError) -> str:
    """Return the message of sbatch in an error of dask-jobqueue."""
    return " ".join(str(error).rpartition("stderr:")[2].split())
