"""Memory that inputs may take: estimated from their headers, and compared before anything is allocated."""

from __future__ import annotations

import contextlib
from functools import cache
from pathlib import Path

from flexroad.tasks.errors import TaskError

SHARE = 0.8
"""Share of the machine's memory that one command may plan to use."""
CGROUP = Path("/sys/fs/cgroup/memory.max")
"""The limit of a container or of a systemd unit."""
GIB = 2**30


@cache
def limit() -> int:
    """Return the memory that a command may plan to use (bytes)."""
    import psutil

    whole = int(psutil.virtual_memory().total)
    # Without a limit, there is no such file, or it has the word "max".
    with contextlib.suppress(OSError, ValueError):
        whole = min(whole, int(CGROUP.read_text()))
    return int(SHARE * whole)


def check(needed: float, what: str, remedy: str, file: str = "") -> None:
    """Check that something fits in memory.

    Parameters
    ----------
    needed : float
        Estimated size (bytes).
    what : str
        What needs it, with the file and its size: the beginning of the message.
    remedy : str
        What the user can do.
    file : str
        The file at fault.

    Raises
    ------
    TaskError
        If it needs more than `limit`.
    """
    if needed > limit():
        raise TaskError(
            f"{what} would need about {needed / GIB:,.1f} GiB of memory, but {limit() / GIB:,.1f} GiB can be "
            f"used on this machine; {remedy}",
            file,
        )
