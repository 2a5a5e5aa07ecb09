"""Dask clusters: on this machine, already running, or requested from SLURM or Kubernetes."""

from __future__ import annotations

import contextlib
import importlib
import logging
import shutil
import sys
import uuid
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import timedelta
from typing import Any

from flexroad.catalog.storage.scratch import ScratchFolder
from flexroad.pipeline import ONE_THREAD
from flexroad.pipeline.config.cluster import Cluster
from flexroad.pipeline.errors import ConfigError

SETTINGS = {
    "distributed.worker.memory.target": False,
    "distributed.worker.memory.spill": False,
    "distributed.worker.memory.pause": False,
    "distributed.worker.memory.terminate": 0.95,
    "distributed.worker.profile.enabled": False,
    "distributed.admin.log-length": 1000,
    "distributed.admin.system-monitor.log-length": 240,
    "distributed.nanny.pre-spawn-environ": ONE_THREAD,
}
"""Dask settings of all workers. Dask's defaults suit data frames that are kept in workers. A tile leaves
nothing that could be spilled to disk, and a paused worker would wait forever for its only tile to free
memory: the worker is terminated at the limit instead. Profiling would cost 2% of a tile's time. The logs of
scheduler and monitor are shorter than by default: they grew for the first hour of a run. Dask also
makes workers return every freed array to the system at once (MALLOC_TRIM_THRESHOLD_), which costs 15% of a
tile's time in page faults: it is left out of their environment."""
DEFAULT_MEMORY_BYTES = 4 * 1024**3
"""Memory of one SLURM or Kubernetes worker if the configuration gives none."""
SILENT_S = 300.0
"""How long a worker may be silent beyond the time limit of a tile (s)."""
GRACE_S = 10.0
"""How long a running scheduler may have no workers (s): a nanny may be replacing one."""
CLUSTER_PACKAGES = {
    "slurm": ("dask_jobqueue", "dask-jobqueue"),
    "kubernetes": ("dask_kubernetes.operator", "dask-kubernetes"),
}
"""Module and package by kind of cluster."""


@dataclass(frozen=True)
class ClusterTarget:
    """The cluster that a client connects to."""

    target: Any
    """An address, or a Dask cluster object."""
    name: str
    """The cluster's name in messages."""
    start_s: float = 0
    """How long to wait for the first worker (s)."""
    own: bool = False
    """Whether the workers were started from this terminal."""


@contextlib.contextmanager
def open_cluster(
    cluster: Cluster, workers: int | None, scheduler: str | None, dashboard: bool
) -> Iterator[ClusterTarget]:
    """Connect to, start or request a cluster; on exit, stop it if it was started here.

    Raises
    ------
    ConfigError
        If a package or program is not installed, or the cluster cannot be started.
    """
    if scheduler:
        yield ClusterTarget(scheduler, f"the Dask scheduler at {scheduler}", GRACE_S)
        return
    if workers:
        cluster = cluster.model_copy(update={"workers": workers})
    import dask

    make = {"local": local, "slurm": slurm, "kubernetes": kubernetes}[cluster.kind]
    with contextlib.ExitStack() as stack:
        # Set until the cluster ends, so that workers that replace dead ones get the settings too.
        stack.enter_context(dask.config.set(settings(cluster)))
        scratch = stack.enter_context(ScratchFolder())
        opened = stack.enter_context(make(cluster, scratch, dashboard))
        start_s = 0 if cluster.kind == "local" else cluster.start_s
        yield ClusterTarget(opened, f"the {cluster.kind} cluster", start_s, cluster.kind == "local")


def settings(cluster: Cluster) -> dict[str, Any]:
    """Return the Dask settings of scheduler and workers."""
    # A worker is silent while a library holds the interpreter. By default it counts as dead after 5 minutes;
    # the time limit of a tile ends it if it hangs.
    return SETTINGS | {"distributed.scheduler.worker-ttl": f"{cluster.tile_timeout_s + SILENT_S:.0f} s"}


def local(cluster: Cluster, scratch: str, dashboard: bool) -> Any:
    """Return a cluster of single-threaded processes on this machine.

    Raises
    ------
    ConfigError
        If the processes cannot be started.
    """
    from distributed import LocalCluster

    from flexroad.pipeline.execute.memory import bytes_of_worker, workers_here

    workers = workers_here(cluster)
    try:
        return LocalCluster(
            n_workers=workers,
            threads_per_worker=1,
            processes=True,
            memory_limit=bytes_of_worker(cluster),
            dashboard_address="127.0.0.1:8787" if dashboard else None,
            worker_dashboard_address=None,
            local_directory=scratch,
            env=ONE_THREAD,
            silence_logs=logging.CRITICAL,
        )
    except (OSError, RuntimeError) as error:
        raise ConfigError(
            f"cannot start {workers} worker processes here: {_one_line(error).rstrip('.')}; use fewer "
            "--workers, or allow more processes and open files (ulimit -u, ulimit -n)"
        ) from error


def slurm(cluster: Cluster, scratch: str, dashboard: bool) -> Any:
    """Return a cluster of SLURM jobs; a job that ends at its walltime is replaced.

    Raises
    ------
    ConfigError
        If dask-jobqueue or sbatch is not installed.
    """
    jobqueue = _extra("slurm")
    if shutil.which("sbatch") is None:
        raise ConfigError(
            "cluster.kind slurm: there is no sbatch here; run this on a login node of the cluster, with the "
            "SLURM client installed, or set `cluster: local`"
        )
    slurm_cluster = jobqueue.SLURMCluster(**slurm_options(cluster, dashboard))
    jobs = -(-(cluster.workers or 1) // cluster.per_job)
    slurm_cluster.adapt(minimum_jobs=jobs, maximum_jobs=jobs)
    return slurm_cluster


def slurm_options(cluster: Cluster, dashboard: bool) -> dict[str, Any]:
    """Return the options of ``SLURMCluster``: jobs of ``per_job`` workers, one thread and core each."""
    walltime = timedelta(hours=cluster.walltime_h)
    # A worker that closes before SLURM kills it returns its tiles to the scheduler.
    lifetime = max(walltime - timedelta(minutes=5), walltime / 2)
    exports = [f"export {name}={value}" for name, value in _environment(cluster).items()]
    return {
        "queue": cluster.queue,
        "account": cluster.account,
        "cores": cluster.per_job,
        "processes": cluster.per_job,
        "memory": f"{(cluster.memory or DEFAULT_MEMORY_BYTES) * cluster.per_job} B",
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
    """Return a cluster of Kubernetes pods, created by the Dask operator.

    Raises
    ------
    ConfigError
        If dask-kubernetes is not installed, no image is set, or the cluster cannot be reached.
    """
    operator = _extra("kubernetes")
    if not cluster.image:
        raise ConfigError(
            "cluster.kind kubernetes: no image is set; set cluster.image to one that contains flexroad"
        )
    spec = operator.make_cluster_spec(**kubernetes_options(cluster))
    # The client libraries raise many types: no credentials, no connection, no operator, no permission.
    try:
        importlib.import_module("kr8s").api(namespace=cluster.namespace).version()
    except Exception as error:
        raise ConfigError(
            f"cluster.kind kubernetes: {_one_line(error)}; does `kubectl get pods` work?"
        ) from error
    try:
        return operator.KubeCluster(
            custom_cluster_spec=spec, namespace=cluster.namespace, quiet=True, resource_timeout=60
        )
    except Exception as error:
        raise ConfigError(
            f"cluster.kind kubernetes: {_one_line(error)}; is the Dask operator installed, and may this "
            "account create DaskCluster resources?"
        ) from error


def kubernetes_options(cluster: Cluster) -> dict[str, Any]:
    """Return the options of ``make_cluster_spec``: pods of one worker, one thread and core each."""
    size = {"cpu": "1", "memory": str(int(cluster.memory or DEFAULT_MEMORY_BYTES))}
    return {
        "name": f"flexroad-{uuid.uuid4().hex[:8]}",
        "image": cluster.image,
        "n_workers": cluster.workers or 1,
        "resources": {"requests": size, "limits": size},
        "env": _environment(cluster),
        "worker_command": "dask worker --nthreads 1",
        # If the client is killed, the cluster ends by itself after this many seconds.
        "idle_timeout": 900,
    }


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split()) or repr(error)


def _environment(cluster: Cluster) -> dict[str, str]:
    """Return the environment of workers, and of a scheduler that is started elsewhere."""
    values = settings(cluster).items()
    return ONE_THREAD | {_variable(key): str(value) for key, value in values}


def _variable(key: str) -> str:
    return f"DASK_{key.replace('.', '__').replace('-', '_').upper()}"


def _extra(kind: str) -> Any:
    module, package = CLUSTER_PACKAGES[kind]
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise ConfigError(
            f"cluster.kind {kind} needs {package}: pip install 'flexroad[{kind}]' ({error})"
        ) from error


def _clock(time: timedelta) -> str:
    minutes = round(time.total_seconds() / 60)
    return f"{minutes // 60:02}:{minutes % 60:02}:00"
