"""SIGINT, SIGTERM and SIGHUP: the first signal interrupts the program, a later signal ends it at once.

A KeyboardInterrupt can be lost: a callback of a C library, such as rasterio's for messages of GDAL, cannot
pass it on. It is therefore raised again until it is being handled.
"""

from __future__ import annotations

import atexit
import contextlib
import os
import select
import signal
import sys
import threading
import time
from collections.abc import Iterator
from types import FrameType
from typing import Any

INTERRUPTED = 130
NUMBERS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
ONE_S = 1.0
"""Signals within this time after the first signal are taken as the same signal (s).

A shell and the terminal that closes both send SIGHUP, and users press Ctrl-C several times."""
SOON_S = 0.001
"""Time after which a lost interrupt is raised again (s): by then the callback has returned."""
AGAIN_S = 0.05
"""Interval of further attempts (s)."""
ENDED = b"ended at once by a second signal; repeat the command\n"


@contextlib.contextmanager
def signals_interrupt() -> Iterator[None]:
    """Raise KeyboardInterrupt at the first SIGINT, SIGTERM or SIGHUP; a later signal ends the process.

    A second context inside the first marks where the interrupt is handled: after it, nothing is raised again.
    """
    outer = getattr(signal.getsignal(signal.SIGTERM), "__self__", None)
    if isinstance(outer, _Signals):
        try:
            yield
        finally:
            outer.stop_raising()
        return
    with _Signals():
        yield


class _Signals:
    """The handlers of the signals, and a thread that receives them even while a C library is at work."""

    def __init__(self) -> None:
        self.first_s: float | None = None
        """Time at which the interrupt was raised (`time.monotonic`), None before it."""
        self.raising = False
        """Whether the interrupt is raised again if it is lost."""

    def __enter__(self) -> None:
        self.before = {number: signal.getsignal(number) for number in NUMBERS}
        self.hooks = sys.unraisablehook, sys.excepthook
        sys.unraisablehook, sys.excepthook = self._lost, self._show
        received, self.send = os.pipe()
        os.set_blocking(self.send, False)
        threading.Thread(target=_watch, args=(received,), name="signals", daemon=True).start()
        self.wakeup = signal.set_wakeup_fd(self.send, warn_on_full_buffer=False)
        for number, handler in self.before.items():
            # Background processes and nohup ignore SIGINT or SIGHUP: these stay ignored.
            if number == signal.SIGTERM or handler is not signal.SIG_IGN:
                signal.signal(number, self._interrupt)

    def __exit__(self, *_: object) -> None:
        self.stop_raising()
        for number, handler in self.before.items():
            # After an interruption a signal that comes with the first one must not change the exit code.
            late = self.first_s is not None and signal.getsignal(number) == self._interrupt
            signal.signal(number, self._late if late else handler)
        signal.set_wakeup_fd(self.wakeup)
        os.close(self.send)
        sys.unraisablehook, sys.excepthook = self.hooks

    def stop_raising(self) -> None:
        """Stop raising the interrupt: it has been handled."""
        if self.raising:
            self.raising = False
            signal.setitimer(signal.ITIMER_REAL, 0)
            signal.signal(signal.SIGALRM, self.alarm)

    def _interrupt(self, *_: object) -> None:
        if self.first_s is None:
            self.first_s = time.monotonic()
            self.alarm = signal.signal(signal.SIGALRM, self._again)
            self.raising = True
            signal.setitimer(signal.ITIMER_REAL, SOON_S, AGAIN_S)
            raise KeyboardInterrupt

    def _again(self, *_: object) -> None:
        """Raise the interrupt, unless it is being handled."""
        error = sys.exception()
        while error is not None and not isinstance(error, KeyboardInterrupt):
            error = error.__context__
        if error is None:
            raise KeyboardInterrupt

    def _lost(self, lost: Any) -> None:
        """Print an error that could not be raised, except the interrupt, which is raised again soon."""
        if not issubclass(lost.exc_type, KeyboardInterrupt):
            self.hooks[0](lost)
        elif self.raising:
            # The hook is called inside the callback, below the frame that called the C library.
            self._raise_in(sys._getframe(1))

    def _raise_in(self, frame: FrameType | None) -> None:
        """Raise the interrupt in a frame as soon as it continues: its call of a C library has then returned.

        An interrupt raised by a timer alone could always meet the library at work, and be lost in a callback.
        """
        before = sys.gettrace()

        def go_on(traced: FrameType, *_: object) -> None:
            traced.f_trace = None
            sys.settrace(before)
            if self.raising:
                self._again()

        if frame is not None:
            frame.f_trace = go_on
            sys.settrace(before or (lambda *_: None))

    def _show(self, kind: type[BaseException], *error: Any) -> None:
        """Print an error, except a lost interrupt, whose traceback Cython prints."""
        if not issubclass(kind, KeyboardInterrupt):
            self.hooks[1](kind, *error)

    def _late(self, number: int, _: object) -> None:
        if self.first_s is not None and time.monotonic() > self.first_s + ONE_S:
            _end(number)


@atexit.register
def _ignore_late() -> None:
    """Ignore further signals of an interrupted program: at the end of Python they would kill it.

    Registered on import, it is called after the other functions of `atexit`, which may wait.
    """
    for number in NUMBERS:
        if isinstance(getattr(signal.getsignal(number), "__self__", None), _Signals):
            signal.signal(number, signal.SIG_IGN)


def _watch(received: int) -> None:
    """End the process at a second signal, until the other end of the pipe is closed."""
    first_s = None
    while numbers := os.read(received, 1):
        if numbers[0] in NUMBERS:
            if first_s is None:
                first_s = time.monotonic()
            elif time.monotonic() > first_s + ONE_S:
                _end(numbers[0])
    os.close(received)


def _end(number: int) -> None:
    """End the process. Its workers end with it; the next command takes over its lock and temporary files."""
    if select.select([], [2], [], 0)[1]:
        with contextlib.suppress(OSError):
            os.write(2, ENDED)
    os._exit(128 + number)
