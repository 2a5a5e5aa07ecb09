"""Standard output and error of a run, whose write errors are ignored: a full log disk must not stop it."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Iterator
from typing import IO, Any


class LenientStream:
    """A text stream that ignores write errors; other attributes are those of the wrapped stream."""

    def __init__(self, stream: IO[str]) -> None:
        self._stream = stream

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        """Write the text; ignore errors."""
        with contextlib.suppress(OSError):
            self._stream.write(text)
        return len(text)

    def flush(self) -> None:
        """Flush the stream; ignore errors."""
        with contextlib.suppress(OSError):
            self._stream.flush()


@contextlib.contextmanager
def ignore_write_errors() -> Iterator[None]:
    """Ignore write errors of this process's standard output and error, which may be None."""
    with (
        contextlib.redirect_stdout(sys.stdout and LenientStream(sys.stdout)),
        contextlib.redirect_stderr(sys.stderr and LenientStream(sys.stderr)),
    ):
        yield
