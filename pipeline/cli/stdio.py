"""What a run has to say is no reason to stop it: the disk of its log may be full, its reader gone."""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Iterator
from typing import IO, Any


class Patient:
    """A stream that takes what nobody can hear; the rest is the stream's own."""

    def __init__(self, stream: IO[str]) -> None:
        self._stream = stream

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        """Write, if that can be."""
        with contextlib.suppress(OSError):
            self._stream.write(text)
        return len(text)

    def flush(self) -> None:
        """Let go of what waits, if that can be."""
        with contextlib.suppress(OSError):
            self._stream.flush()


@contextlib.contextmanager
def patient() -> Iterator[None]:
    """Let both outputs of this process take everything."""
    with contextlib.ExitStack() as stack:
        for name, stream in (("stdout", sys.stdout), ("stderr", sys.stderr)):
            # A process that was started without one has none.
            if stream is not None:
                stack.callback(_give_back, name, stream)
                setattr(sys, name, Patient(stream))
        yield


def _give_back(name: str, stream: IO[str]) -> None:
    setattr(sys, name, stream)
    try:
        stream.flush()
    except OSError:
        # What still waits would spoil the exit code as the process ends.
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())
