"""Memory that the processes of this machine may use."""

from __future__ import annotations

import contextlib
from pathlib import Path

from distributed.system import MEMORY_LIMIT

MOUNT = Path("/sys/fs/cgroup")
OWN = Path("/proc/self/cgroup")


def available_bytes(mount: Path = MOUNT, own: Path = OWN) -> int:
    """Return the memory that this process and its workers may use together.

    Dask's number is that of the machine, the container and the limits of the process. The limits of a
    systemd unit (``MemoryMax=``) or of a SLURM job are those of this process's own control group and of the
    groups around it.

    Parameters
    ----------
    mount, own : Path
        Where the control groups are, and the file with the name of the process's own one.
    """
    limits = [int(MEMORY_LIMIT)]
    with contextlib.suppress(OSError, ValueError):
        for line in own.read_text().splitlines():
            _, kinds, name = line.split(":", 2)
            if kinds in ("", "memory"):
                group = mount / kinds / name.strip("/")
                limits += [limit for folder in (group, *group.parents) for limit in _limits(folder)]
    return min(limits)


def _limits(group: Path) -> list[int]:
    """Return the limits of one control group (bytes): of version 2, or of version 1."""
    found = []
    for name in ("memory.max", "memory.high", "memory.limit_in_bytes"):
        # "max" is no limit.
        with contextlib.suppress(OSError, ValueError):
            found.append(int((group / name).read_text()))
    return [limit for limit in found if limit > 0]
