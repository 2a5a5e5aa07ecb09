"""Memory that the processes of this machine may use."""

from __future__ import annotations

from pathlib import Path

from dask.system import CPU_COUNT
from distributed.system import MEMORY_LIMIT

from flexroad.pipeline.config.cluster import Cluster
from flexroad.tasks.memory import MOUNT, OWN, group_limits


def available_bytes(mount: Path = MOUNT, own: Path = OWN) -> int:
    """Return the memory that this process and its workers may use together.

    Dask's number is that of the machine, the container and the limits of the process. It does not have the
    limits of a systemd unit or of a SLURM job (`group_limits`, with the same parameters).
    """
    return min([int(MEMORY_LIMIT), *group_limits(mount, own)])


def workers_here(cluster: Cluster) -> int:
    """Return the number of processes on this machine: by default one for each core of the container."""
    return cluster.workers or CPU_COUNT


def bytes_of_worker(cluster: Cluster) -> int:
    """Return the memory of a process on this machine (bytes): by default an equal share of what is there."""
    return int(cluster.memory or available_bytes() // workers_here(cluster))
