"""Limits that the system sets for this process, and remedies for errors of the system."""

from __future__ import annotations

import errno
import resource

from flexroad.pipeline.errors import ConfigError

OPEN_FILES = 256
"""Number of open files that a command needs: a process keeps up to 64 rasters open beside its libraries."""
ENOUGH_OPEN_FILES = 2**16
"""The soft limit of open files is raised to this at most."""
ADDRESS_SPACE = 2 * 2**30
"""Smallest address space in which the libraries of a tile can be loaded (bytes)."""
MORE_SPACE = "raise the limit with `ulimit -v unlimited`, or limit the memory by a control group instead"
COMPUTING = ("run", "rerun", "prepare", "train", "export", "report", "figures")
"""Commands that load the libraries of a tile."""
OUT_OF_MEMORY = (
    "Cannot allocate memory",
    "failed to map segment",
    "can't start new thread",
    "Failed to launch worker thread",
    "malloc of size",
)
"""Words in the errors of libraries that find no memory; these errors have many types."""


def raise_open_files() -> None:
    """Raise the soft limit of open files towards the hard limit; this needs no permission."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    target = ENOUGH_OPEN_FILES if hard == resource.RLIM_INFINITY else min(hard, ENOUGH_OPEN_FILES)
    if soft != resource.RLIM_INFINITY and soft < target:
        resource.setrlimit(resource.RLIMIT_NOFILE, (target, hard))


def check(command: str | None) -> None:
    """Check that the limits are large enough for a command."""
    if command not in COMPUTING:
        return
    files, space = _limit(resource.RLIMIT_NOFILE), _limit(resource.RLIMIT_AS)
    if files is not None and files < OPEN_FILES:
        raise ConfigError(
            f"this process may open only {files} files, and needs {OPEN_FILES}; {_more_files()}"
        )
    if space is not None and space < ADDRESS_SPACE:
        raise ConfigError(f"{_space(space)}, and needs at least {ADDRESS_SPACE >> 10:,} KiB; {MORE_SPACE}")


def remedy(error: OSError) -> str:
    """Return the remedy for an error of the system."""
    if error.errno in (errno.EMFILE, errno.ENFILE):
        return f"this process may open {_limit(resource.RLIMIT_NOFILE)} files; {_more_files()}"
    if error.errno in (errno.EACCES, errno.EPERM):
        return "give this user access"
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return "free disk space"
    return "check the path and the disk"


def memory_reason(error: BaseException) -> str | None:
    """Return the reason and remedy of an error for lack of memory or address space; None for other errors."""
    text = str(error)
    if not isinstance(error, MemoryError) and not any(words in text for words in OUT_OF_MEMORY):
        return None
    space = _limit(resource.RLIMIT_AS)
    if space is None:
        return "there is not enough memory; use fewer --workers or a machine with more"
    return f"{_space(space)}, which is not enough; {MORE_SPACE}"


def _limit(kind: int) -> int | None:
    """Return the soft limit, None if it is unlimited."""
    soft, _ = resource.getrlimit(kind)
    return None if soft == resource.RLIM_INFINITY else soft


def _space(limit: int) -> str:
    return f"the address space of this process is limited to {limit >> 10:,} KiB"


def _more_files() -> str:
    return f"raise the limit with `ulimit -n {4 * OPEN_FILES}`"
