"""Memory that the processes of this machine may use."""

from __future__ import annotations

from pathlib import Path

from distributed.system import MEMORY_LIMIT

from flexroad.tasks.memory import MOUNT, OWN, group_limits


def available_bytes(mount: Path = MOUNT, own: Path = OWN) -> int:
    """Return the memory that this process and its workers may use together.

    Dask's number is that of the machine, the container and the limits of the process. It does not have the
    limits of a systemd unit or of a SLURM job (`group_limits`, with the same parameters).
    """
    return min([int(MEMORY_LIMIT), *group_limits(mount, own)])
