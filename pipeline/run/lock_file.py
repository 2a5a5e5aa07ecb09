"""The file of a lock: made only where there is none, replaced only if it is still the one seen.

Its age is told by the clock of the storage alone: the time of a file written just now less its own.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from flexroad.catalog.storage.paths import write


@dataclass(frozen=True)
class LockStat:
    """A lock as it was seen."""

    data: bytes
    written: float
    """Time of the last heartbeat by the storage's clock."""
    age_s: float
    """How long ago that was; negative where the clock was set back since."""
    version: str = ""
    """What the bucket calls it."""


class LockFile(Protocol):
    """What a lock asks of the storage; everything may raise OSError."""

    def create(self, data: bytes) -> bool:
        """Make it; False if there is one."""

    def look(self) -> LockStat | None:
        """Return it, or None if there is none."""

    def replace(self, seen: LockStat, data: bytes) -> bool:
        """Put another in its place; False if it is no longer the one seen."""

    def beat(self, seen: LockStat) -> None:
        """Renew its time."""

    def remove(self, seen: LockStat) -> None:
        """Take it away if it is still the one seen."""


@dataclass(frozen=True)
class OnDisk:
    """A file in a folder, of this machine or of a network."""

    path: Path

    def create(self, data: bytes) -> bool:
        """Make it; False if there is one."""
        try:
            descriptor = os.open(self.path, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666)
        except FileExistsError:
            return False
        try:
            with os.fdopen(descriptor, "wb") as file:
                file.write(data)
        except OSError:
            self.path.unlink(missing_ok=True)
            raise
        return True

    def look(self) -> LockStat | None:
        """Return it, or None if there is none."""
        try:
            with self.path.open("rb") as file:
                data, written = file.read(), os.fstat(file.fileno()).st_mtime
        except FileNotFoundError:
            return None
        age_s = 0.0
        # On a full disk no age can be told: others' locks count as young, and one's own is given back.
        with contextlib.suppress(OSError), tempfile.TemporaryFile(dir=self.path.parent) as probe:
            age_s = os.fstat(probe.fileno()).st_mtime - written
        return LockStat(data, written, age_s)

    def replace(self, seen: LockStat, data: bytes) -> bool:
        """Put another in its place; False if it is no longer the one seen."""
        with contextlib.ExitStack() as stack:
            same = self._guarded(stack, seen)
            if same:
                write(self.path, data)
        return same

    def beat(self, seen: LockStat) -> None:
        """Renew its time."""
        # Without a time of ours, a network's server takes its own.
        os.utime(self.path)

    def remove(self, seen: LockStat) -> None:
        """Take it away if it is still the one seen."""
        with contextlib.ExitStack() as stack:
            if self._guarded(stack, seen):
                self.path.unlink()

    def _guarded(self, stack: contextlib.ExitStack, seen: LockStat) -> bool:
        """Keep others from replacing this very file for a moment; tell whether it is the one seen."""
        try:
            file = stack.enter_context(self.path.open("rb+"))
            # Where the file system knows no such locks, two may replace it in the same millisecond.
            with contextlib.suppress(OSError):
                fcntl.flock(file, fcntl.LOCK_EX)
            # Whoever waited here finds that the name leads to another file by now.
            named = os.path.samestat(os.fstat(file.fileno()), self.path.stat())
        except FileNotFoundError:
            return False
        return named and file.read() == seen.data
