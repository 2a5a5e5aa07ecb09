"""The file of a lock in object storage, created and replaced by conditional requests."""

from __future__ import annotations

import errno
from dataclasses import dataclass
from email.utils import parsedate_to_datetime
from typing import Any

from upath import UPath

from flexroad.catalog.storage.paths import named, read, remove
from flexroad.pipeline.run.lock_file import LockStat

REFUSED = (409, 412)
"""HTTP status of a rejected conditional request: a conflicting request, or the condition is not met."""


@dataclass(frozen=True)
class InBucket:
    """A lock file in a bucket."""

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
