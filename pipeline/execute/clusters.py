"""Where the scheduler is: on this machine, running already, or asked for from SLURM or Kubernetes."""

from __future__ import annotations

import contextlib
import importlib
import logging
import shutil
import sys
import tempfile
import uuid
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import timedelta
from typing import Any

from flexroad.pipeline import ONE_THREAD
from flexroad.pipeline.config.cluster import Cluster
from flexroad.pipeline.errors import ConfigError

SETTINGS = {
    "distributed.worker.memory.target": False,
    "distributed.worker.memory.spill": False,
    "distributed.worker.memory.pause": False,
    "distributed.worker.memory.terminate": 0.95,
    "distributed.worker.profile.enabled": False,
}
"""Dask's settings are for data frames that lie in workers. A tile leaves nothing to write to disk, and a
worker that paused would wait forever for its only tile to give memory back; so it is stopped at the limit.
Looking a hundred times a second at what a worker does would cost 2% of a tile; the journal tells more."""
ELSEWHERE_BYTES = 4 * 1024**3
"""Memory of a worker of a cluster that is asked for, where nothing is said."""
GRACE_S = 10.0
"""How long a running scheduler may be without workers: a nanny may be at replacing one."""
ASKED_FOR = {
    "slurm": ("dask_jobqueue", "dask-jobqueue"),
    "kubernetes": ("dask_kubernetes.operator", "dask-kubernetes"),
}


@dataclass(frozen=True)
class ClusterTarget:
    """Where a client connects to."""

    target: Any
    """An address, or a cluster object of Dask's."""
    name: str
    start_s: float = 0
    """How long to wait for the first worker."""
    own: bool = False
    """Whether the workers are of this terminal."""


@contextlib.contextmanager
def open_cluster(
    cluster: Cluster, workers: int | None, scheduler: str | None, dashboard: bool
) -> Iterator[ClusterTarget]:
    """Start, ask for or find a cluster, and end what was started.

    Raises
    ------
    ConfigError
        If something is not installed, or the cluster cannot be had.
    """
    if scheduler:
        yield ClusterTarget(scheduler, f"the Dask scheduler at {scheduler}", GRACE_S)
        return
    if workers:
        cluster = cluster.model_copy(update={"workers": workers})
    import dask

    make = {"local": local, "slurm": slurm, "kubernetes": kubernetes}[cluster.kind]
    with contextlib.ExitStack() as stack:
        # For as long as it lasts: workers that follow those that died are to know it, too.
        stack.enter_context(dask.config.set(SETTINGS))
        scratch = stack.enter_context(tempfile.TemporaryDirectory(prefix="flexroad-"))
        made = stack.enter_context(make(cluster, scratch, dashboard))
        start_s = 0 if cluster.kind == "local" else cluster.start_s
        yield ClusterTarget(made, f"the {cluster.kind} cluster", start_s, cluster.kind == "local")


def local(cluster: Cluster, scratch: str, dashboard: bool) -> Any:
    """Return processes of one thread on this machine.

    Raises
    ------
    ConfigError
        If they cannot be started.
    """
    from dask.system import CPU_COUNT
    from distributed import LocalCluster
    from distributed.system import MEMORY_LIMIT

    # As far as a container may use them.
    workers = cluster.workers or CPU_COUNT
    try:
        return LocalCluster(
            n_workers=workers,
            threads_per_worker=1,
            processes=True,
            memory_limit=cluster.memory or MEMORY_LIMIT // workers,
            dashboard_address="127.0.0.1:8787" if dashboard else None,
            worker_dashboard_address=None,
            local_directory=scratch,
            env=ONE_THREAD,
            silence_logs=logging.CRITICAL,
        )
    except (OSError, RuntimeError) as error:
        raise ConfigError(
            f"cannot start {workers} worker processes here: {_line(error).rstrip('.')}; take fewer "
            "--workers, or allow more processes and open files (ulimit -u, ulimit -n)"
        ) from error


def slurm(cluster: Cluster, scratch: str, dashboard: bool) -> Any:
    """Return workers that SLURM gives; when jobs end at their walltime others are asked for.

    Raises
    ------
    ConfigError
        If dask-jobqueue or sbatch is not there.
    """
    jobqueue = _extra("slurm")
    if shutil.which("sbatch") is None:
        raise ConfigError(
            "cluster.kind slurm: there is no sbatch here; run this on a login node of the cluster, with the "
            "SLURM client installed, or say `cluster: local`"
        )
    made = jobqueue.SLURMCluster(**slurm_options(cluster, dashboard))
    jobs = -(-(cluster.workers or 1) // cluster.per_job)
    made.adapt(minimum_jobs=jobs, maximum_jobs=jobs)
    return made


def slurm_options(cluster: Cluster, dashboard: bool) -> dict[str, Any]:
    """Return what ``SLURMCluster`` is asked for: jobs of ``per_job`` workers, one thread and core each."""
    walltime = timedelta(hours=cluster.walltime_h)
    # A worker that leaves by itself before SLURM ends it gives its tiles back.
    lifetime = max(walltime - timedelta(minutes=5), walltime / 2)
    exports = [f"export {name}={value}" for name, value in _environment().items()]
    return {
        "queue": cluster.queue,
        "account": cluster.account,
        "cores": cluster.per_job,
        "processes": cluster.per_job,
        "memory": f"{(cluster.memory or ELSEWHERE_BYTES) * cluster.per_job} B",
        "walltime": _clock(walltime),
        "job_extra_directives": list(cluster.job_extra),
        "job_script_prologue": [*exports, *cluster.prologue],
        "worker_extra_args": ["--lifetime", f"{lifetime.total_seconds():.0f}s", "--lifetime-stagger", "60s"],
        "python": sys.executable,
        "job_name": "flexroad",
        "interface": cluster.interface,
        "scheduler_options": {"dashboard_address": ":8787" if dashboard else ":0"},
        "silence_logs": "critical",
    }


def kubernetes(cluster: Cluster, scratch: str, dashboard: bool) -> Any:
    """Return workers in pods, by the Dask operator.

    Raises
    ------
    ConfigError
        If dask-kubernetes or the cluster is not there.
    """
    operator = _extra("kubernetes")
    if not cluster.image:
        raise ConfigError(
            "cluster.kind kubernetes: which image? set cluster.image to one with flexroad in it"
        )
    spec = operator.make_cluster_spec(**kubernetes_options(cluster))
    # Whatever the client libraries raise: no credentials, nobody there, no operator, no rights.
    try:
        importlib.import_module("kr8s").api(namespace=cluster.namespace).version()
    except Exception as error:
        raise ConfigError(
            f"cluster.kind kubernetes: {_line(error)}; does `kubectl get pods` work?"
        ) from error
    try:
        return operator.KubeCluster(
            custom_cluster_spec=spec, namespace=cluster.namespace, quiet=True, resource_timeout=60
        )
    except Exception as error:
        raise ConfigError(
            f"cluster.kind kubernetes: {_line(error)}; is the Dask operator installed, and may this account "
            "make DaskCluster resources?"
        ) from error


def kubernetes_options(cluster: Cluster) -> dict[str, Any]:
    """Return what ``make_cluster_spec`` is asked for: pods of one worker, one thread and core each."""
    size = {"cpu": "1", "memory": str(int(cluster.memory or ELSEWHERE_BYTES))}
    return {
        "name": f"flexroad-{uuid.uuid4().hex[:8]}",
        "image": cluster.image,
        "n_workers": cluster.workers or 1,
        "resources": {"requests": size, "limits": size},
        "env": _environment(),
        "worker_command": "dask worker --nthreads 1",
        # Whoever is killed leaves no cluster behind.
        "idle_timeout": 900,
    }


def _line(error: Exception) -> str:
    return " ".join(str(error).split()) or repr(error)


def _environment() -> dict[str, str]:
    settings = {f"DASK_{key.replace('.', '__').upper()}": str(value) for key, value in SETTINGS.items()}
    return ONE_THREAD | settings


def _extra(kind: str) -> Any:
    module, package = ASKED_FOR[kind]
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise ConfigError(
            f"cluster.kind {kind} needs {package}: pip install 'flexroad[{kind}]' ({error})"
        ) from error


def _clock(time: timedelta) -> str:
    minutes = round(time.total_seconds() / 60)
    return f"{minutes // 60:02}:{minutes % 60:02}:00"
