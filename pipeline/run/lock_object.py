"""The file of a lock in object storage: conditional requests do what a disk's exclusive creation does."""

from __future__ import annotations

import errno
from dataclasses import dataclass
from email.utils import parsedate_to_datetime
from typing import Any

from upath import UPath

from flexroad.catalog.storage.paths import named, read, remove
from flexroad.pipeline.run.lock_file import LockStat

REFUSED = (409, 412)
"""Answers to a conditional request: another came in between, a condition not met."""


@dataclass(frozen=True)
class InBucket:
    """An object that is replaced only if it is still the one seen."""

    path: UPath

    def create(self, data: bytes) -> bool:
        """Make it; False if there is one."""
        try:
            return self._put(data, REFUSED, IfNoneMatch="*")
        except FileNotFoundError as error:
            raise OSError(errno.EIO, "there is no such bucket", str(self.path)) from error

    def look(self) -> LockStat | None:
        """Return it, or None if there is none."""
        bucket, key, _ = self.path.fs.split_path(self.path.path)
        try:
            with named(self.path):
                head = self.path.fs.call_s3("head_object", Bucket=bucket, Key=key)
            data = read(self.path)
        except FileNotFoundError:
            return None
        written = head["LastModified"].timestamp()
        # Every answer tells the server's own time.
        now = parsedate_to_datetime(head["ResponseMetadata"]["HTTPHeaders"]["date"]).timestamp()
        return LockStat(data, written, now - written, head["ETag"])

    def replace(self, seen: LockStat, data: bytes) -> bool:
        """Put another in its place; False if it is no longer the one seen."""
        return self._put(data, (404, *REFUSED), IfMatch=seen.version)

    def beat(self, seen: LockStat) -> None:
        """Renew its time."""
        self.replace(seen, seen.data)

    def remove(self, seen: LockStat) -> None:
        """Take it away, seen a moment ago."""
        # Not every storage knows conditions on that; only who was silent for minutes can have lost it since.
        remove(self.path)

    def _put(self, data: bytes, refusals: tuple[int, ...], **condition: str) -> bool:
        try:
            with named(self.path):
                self.path.fs.pipe_file(self.path.path, data, **condition)
        except OSError as error:
            if _status(error) in refusals:
                return False
            raise
        return True


def _status(error: BaseException | None) -> int | None:
    """Return the HTTP status that an error goes back to."""
    while error is not None:
        response: dict[str, Any] | None = getattr(error, "response", None)
        if isinstance(response, dict):
            return int(response["ResponseMetadata"]["HTTPStatusCode"])
        error = error.__cause__
    return None
