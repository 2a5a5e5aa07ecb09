"""The file of a lock: created only if it does not exist, replaced only if unchanged since it was read.

In object storage, conditional requests create and replace it. Its age is measured with the clock of the
storage: the time of a file written now minus its own time.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import tempfile
from dataclasses import dataclass
from email.utils import parsedate_to_datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from flexroad.catalog.storage.paths import Location, named, read, remove, write

if TYPE_CHECKING:
    from upath import UPath

REFUSED = (409, 412)
"""HTTP status of a rejected conditional request: 409 for a conflict, 412 for a condition that is not met."""


@dataclass(frozen=True)
class LockStat:
    """Content, time and version of a lock file when it was read."""

    data: bytes
    written: float
    """Time of the last renewal by the storage's clock (s since the epoch)."""
    age_s: float
    """Time since the last renewal (s); negative if the clock was set back."""
    version: str = ""
    """ETag of the object in a bucket; empty on disk."""


@dataclass(frozen=True)
class OnDisk:
    """A lock file on a local or network disk; each method may raise OSError."""

    path: Path

    def create(self, data: bytes) -> bool:
        """Create the file; False if it exists."""
        try:
            descriptor = os.open(self.path, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666)
        except FileExistsError:
            return False
        try:
            with os.fdopen(descriptor, "wb") as file:
                file.write(data)
                file.flush()
                # After a power failure the owner of an empty lock would be unknown.
                os.fsync(file.fileno())
        except OSError:
            self.path.unlink(missing_ok=True)
            raise
        return True

    def read(self) -> LockStat | None:
        """Return content and age of the file, None if it does not exist."""
        try:
            with self.path.open("rb") as file:
                data, written = file.read(), os.fstat(file.fileno()).st_mtime
        except FileNotFoundError:
            return None
        age_s = 0.0
        # On a full disk the age is unknown and 0 is returned, so that locks of other processes stay valid.
        with contextlib.suppress(OSError), tempfile.TemporaryFile(dir=self.path.parent) as probe:
            age_s = os.fstat(probe.fileno()).st_mtime - written
        return LockStat(data, written, age_s)

    def replace(self, expected: LockStat, data: bytes) -> bool:
        """Replace the content; False if the file has changed since ``expected`` was read."""
        with contextlib.ExitStack() as stack:
            unchanged = self._locked_unchanged(stack, expected)
            if unchanged:
                write(self.path, data, flushed=True)
        return unchanged

    def renew(self, expected: LockStat) -> None:
        """Set the file's time to now."""
        # Without an explicit time, a network file server uses its own clock.
        os.utime(self.path)

    def remove(self, expected: LockStat) -> None:
        """Remove the file if it has not changed since ``expected`` was read."""
        with contextlib.ExitStack() as stack:
            if self._locked_unchanged(stack, expected):
                self.path.unlink()

    def _locked_unchanged(self, stack: contextlib.ExitStack, expected: LockStat) -> bool:
        """Lock the file with flock until ``stack`` is closed; return whether its content is as expected."""
        try:
            file = stack.enter_context(self.path.open("rb+"))
            # On a file system without flock, two processes could replace the file at the same moment.
            with contextlib.suppress(OSError):
                fcntl.flock(file, fcntl.LOCK_EX)
            # While this process waited for flock, another may have replaced the file.
            same_file = os.path.samestat(os.fstat(file.fileno()), self.path.stat())
        except FileNotFoundError:
            return False
        return same_file and file.read() == expected.data


@dataclass(frozen=True)
class InBucket:
    """A lock file in a bucket, with the methods of `OnDisk`."""

    path: UPath

    def create(self, data: bytes) -> bool:
        """Create the object; False if it exists."""
        try:
            return self._put(data, REFUSED, IfNoneMatch="*")
        except FileNotFoundError as error:
            raise OSError(errno.EIO, "there is no such bucket", str(self.path)) from error

    def read(self) -> LockStat | None:
        """Return content, age and ETag of the object, None if it does not exist."""
        bucket, key, _ = self.path.fs.split_path(self.path.path)
        try:
            with named(self.path):
                head = self.path.fs.call_s3("head_object", Bucket=bucket, Key=key)
            data = read(self.path)
        except FileNotFoundError:
            return None
        written = head["LastModified"].timestamp()
        # The server's time is a header of every response.
        now = parsedate_to_datetime(head["ResponseMetadata"]["HTTPHeaders"]["date"]).timestamp()
        return LockStat(data, written, now - written, head["ETag"])

    def replace(self, expected: LockStat, data: bytes) -> bool:
        """Replace the content; False if the object has changed since ``expected`` was read."""
        return self._put(data, (404, *REFUSED), IfMatch=expected.version)

    def renew(self, expected: LockStat) -> None:
        """Set the object's time to now, by writing the same content."""
        self.replace(expected, expected.data)

    def remove(self, expected: LockStat) -> None:
        """Remove the object; the caller has just read it."""
        # Not all storages support conditional deletion. Another process takes a lock over only if it has not
        # been renewed for minutes.
        remove(self.path)

    def _put(self, data: bytes, refusals: tuple[int, ...], **condition: str) -> bool:
        """Write the object under a condition; False if the storage answers with one of ``refusals``."""
        try:
            with named(self.path):
                self.path.fs.pipe_file(self.path.path, data, **condition)
        except OSError as error:
            if _status(error) in refusals:
                return False
            raise
        return True


def _status(error: BaseException | None) -> int | None:
    """Return the HTTP status of an error or of its causes, None if it has none."""
    while error is not None:
        response: dict[str, Any] | None = getattr(error, "response", None)
        if isinstance(response, dict):
            return int(response["ResponseMetadata"]["HTTPStatusCode"])
        error = error.__cause__
    return None


def lock_file(path: Location) -> OnDisk | InBucket:
    """Return a lock file on disk or in a bucket."""
    return OnDisk(path) if isinstance(path, Path) else InBucket(path)
