"""GDAL's messages about damaged files that quote bytes which are no UTF-8.

rasterio decodes each message for its log, in functions that cannot raise: of such a message Python prints the
UnicodeDecodeError, with "Exception ignored". The reader of the file reports its damage by itself.
"""

from __future__ import annotations

import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import TracebackType
from typing import Any

HANDLERS = (
    "rasterio._env.log_error",
    "rasterio._err.log_error",
    "rasterio._err.chaining_error_handler",
)
"""rasterio's functions that decode GDAL's messages and cannot raise."""


class _Hooks:
    """Python's two hooks that print such an error, replaced while any thread needs it."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._users = 0

    def install(self) -> None:
        with self._lock:
            self._users += 1
            if self._users == 1:
                self._unraisable, self._printed = sys.unraisablehook, sys.excepthook
                sys.unraisablehook, sys.excepthook = self._unless_ignored, self._unless_traceless

    def remove(self) -> None:
        with self._lock:
            self._users -= 1
            if not self._users:
                sys.unraisablehook, sys.excepthook = self._unraisable, self._printed

    def _unless_ignored(self, event: Any) -> None:
        if event.exc_type is not UnicodeDecodeError or event.object not in HANDLERS:
            self._unraisable(event)

    def _unless_traceless(
        self, kind: type[BaseException], value: BaseException, traceback: TracebackType | None
    ) -> None:
        # Cython prints the error itself, before it is ignored; an error of Python has a traceback.
        if kind is not UnicodeDecodeError or traceback is not None:
            self._printed(kind, value, traceback)


_hooks = _Hooks()


@contextmanager
def undecodable_ignored() -> Iterator[None]:
    """Print nothing about GDAL's messages that rasterio cannot decode."""
    _hooks.install()
    try:
        yield
    finally:
        _hooks.remove()
