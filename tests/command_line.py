"""The command line, run in this process or in a new one."""

import contextlib
import faulthandler
import io
import os
import signal
import subprocess
import sys
import time
import traceback
from collections.abc import Callable
from typing import NamedTuple
from unittest import mock

import pytest

from flexroad.pipeline.cli.main import main

PROCESS = (sys.executable, "-c", "from flexroad.pipeline.cli.main import main; main()")
"""Command of a new process; the words of a command line follow."""
FORKED_S = 120
"""Longest time of a function in a copy of this process (s)."""
RAISED = 99
"""Exit code of a copy of this process in which the function raised an error."""


class Said(NamedTuple):
    code: int
    out: str
    err: str

    @property
    def errors(self) -> list[str]:
        """The error lines on standard error."""
        return error_lines(self.err)

    def expected(self, code: int) -> "Said":
        """Assert the exit code."""
        assert self.code == code, self.out + self.err
        return self


def error_lines(text: str) -> list[str]:
    """The error lines in a text that also has progress lines."""
    return [line for line in text.splitlines() if line.startswith(("error: ", "failed "))]


@contextlib.contextmanager
def same_signals():
    """Restore the signal handlers, which a command replaces in this process."""
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def call(*words) -> Said:
    """Run a command line in this process; fail on a traceback."""
    out, err = io.StringIO(), io.StringIO()
    with (
        same_signals(),
        mock.patch.object(sys, "argv", ["flexroad", *map(str, words)]),
        mock.patch.dict(os.environ, COLUMNS="200"),
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(err),
        pytest.raises(SystemExit) as end,
    ):
        main()
    said = Said(int(end.value.code or 0), out.getvalue(), err.getvalue())
    assert "Traceback" not in said.err
    return said


def process(*words) -> Said:
    """Run a command line in a new process."""
    done = subprocess.run(
        [*PROCESS, *map(str, words)],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "COLUMNS": "200"},
    )
    assert "Traceback" not in done.stderr
    return Said(done.returncode, done.stdout, done.stderr)


def forked(function: Callable[[], int], attempts: int = 2) -> int:
    """Call a function in a copy of this process; return the exit code that it gives, or minus a signal.

    A copy stands for ever at a lock that another thread had when the copy was made. It then ends after
    `FORKED_S`, and another copy is made.
    """
    sys.stderr.flush()
    start = time.monotonic()
    if child := os.fork():
        code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        stood = time.monotonic() - start >= FORKED_S
        return forked(function, attempts - 1) if stood and attempts > 1 else code
    code = RAISED
    try:
        # Says where the copy stands.
        faulthandler.dump_traceback_later(FORKED_S, exit=True, file=sys.__stderr__)
        code = int(function())
    except BaseException:
        traceback.print_exc()
        sys.stderr.flush()
    finally:
        os._exit(code)
