"""Settings of Dask in the processes of a cluster, and the certificates of their connections."""

from __future__ import annotations

from typing import Any

from flexroad.pipeline import ONE_THREAD
from flexroad.pipeline.config.cluster import Cluster

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
SILENT_S = 300.0
"""How long a worker may be silent beyond the time limit of a tile (s)."""


def settings(cluster: Cluster, dashboard: bool) -> dict[str, Any]:
    """Return the Dask settings of scheduler and workers."""
    # A worker is silent while a library holds the interpreter. By default it counts as dead after 5 minutes;
    # the time limit of a tile ends it if it hangs.
    values = SETTINGS | {"distributed.scheduler.worker-ttl": f"{cluster.tile_timeout_s + SILENT_S:.0f} s"}
    if cluster.kind == "local":
        # A worker that died is started again here. Dask looks for it 15 s after each death, by default, and
        # gives it up for ever if it has died a second time and is just being started.
        values["distributed.deploy.lost-worker-timeout"] = "1000 d"
    if cluster.kind != "kubernetes":
        # Web pages ask for no certificate. The Dask operator of Kubernetes needs them.
        values["distributed.worker.http.routes"] = []
        if not dashboard:
            values["distributed.scheduler.http.routes"] = []
    return values


def web_address(dashboard: bool) -> str:
    """Return the address of the scheduler's web pages: on this machine only, as they ask for no password."""
    return f"127.0.0.1:{8787 if dashboard else 0}"


def environment(cluster: Cluster, dashboard: bool) -> dict[str, str]:
    """Return the environment of workers, and of a scheduler that is started elsewhere."""
    values = settings(cluster, dashboard).items()
    return ONE_THREAD | {_variable(key): str(value) for key, value in values}


def certificates(cluster: Cluster) -> Any:
    """Return new certificates for the connections of a cluster, None with ``security: none``."""
    from distributed.security import Security

    return Security.temporary() if cluster.security == "tls" else None


def _variable(key: str) -> str:
    return f"DASK_{key.replace('.', '__').replace('-', '_').upper()}"
