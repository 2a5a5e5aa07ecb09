"""Memory that inputs may take: estimated from their headers, and checked before it is allocated."""

from __future__ import annotations

import contextlib
from functools import cache
from pathlib import Path

from flexroad.catalog.lazy import lazy
from flexroad.tasks.errors import TaskError

psutil = lazy("psutil")

SHARE = 0.8
"""Share of the machine's memory that one command may plan to use."""
MOUNT = Path("/sys/fs/cgroup")
OWN = Path("/proc/self/cgroup")
GIB = 2**30


def group_limits(mount: Path = MOUNT, own: Path = OWN) -> list[int]:
    """Return the memory limits of this process's control group and of the groups around it (bytes).

    These are the limits of a container, of a systemd unit (``MemoryMax=``) or of a SLURM job; else empty.

    - `mount`, `own`: the folder of control groups, and the file with the name of the process's own group.
    """
    limits: list[int] = []
    with contextlib.suppress(OSError, ValueError):
        for line in own.read_text().splitlines():
            _, kinds, name = line.split(":", 2)
            if kinds in ("", "memory"):
                group = mount / kinds / name.strip("/")
                limits += [limit for folder in (group, *group.parents) for limit in _limits(folder)]
    return limits


def _limits(group: Path) -> list[int]:
    """Return the limits of one control group (bytes): of version 2, or of version 1."""
    found = []
    for name in ("memory.max", "memory.high", "memory.limit_in_bytes"):
        # "max" means no limit.
        with contextlib.suppress(OSError, ValueError):
            found.append(int((group / name).read_text()))
    return [limit for limit in found if limit > 0]


@cache
def limit() -> int:
    """Return the memory that a command may plan to use (bytes)."""
    return int(SHARE * min([psutil.virtual_memory().total, *group_limits()]))


def check(needed: float, what: str, remedy: str, file: str = "") -> None:
    """Check that something fits in memory.

    - `needed`: estimated size (bytes).
    - `what`: the beginning of the message: the object that needs the memory, with the file and its size.
    """
    if needed > limit():
        raise TaskError(
            f"{what} would need about {needed / GIB:,.1f} GiB of memory, but {limit() / GIB:,.1f} GiB can be "
            f"used on this machine; {remedy}",
            file,
        )
