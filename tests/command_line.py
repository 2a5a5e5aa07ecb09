"""The command line in this process, and as a process of its own."""

import contextlib
import io
import os
import signal
import subprocess
import sys
from typing import NamedTuple
from unittest import mock

import pytest

from flexroad.pipeline.cli.main import main

PROCESS = (sys.executable, "-c", "from flexroad.pipeline.cli.main import main; main()")
"""Followed by the words of a command line."""


class Said(NamedTuple):
    code: int
    out: str
    err: str

    @property
    def errors(self) -> list[str]:
        """The lines that tell of faults."""
        return error_lines(self.err)

    def expected(self, code: int) -> "Said":
        """Insist on an exit code."""
        assert self.code == code, self.out + self.err
        return self


def error_lines(text: str) -> list[str]:
    """The lines that tell of faults, among those of progress."""
    return [line for line in text.splitlines() if line.startswith(("error: ", "failed "))]


@contextlib.contextmanager
def same_signals():
    """A command takes some signals over; here it is no process of its own."""
    before = {which: signal.getsignal(which) for which in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    try:
        yield
    finally:
        for which, handler in before.items():
            signal.signal(which, handler)


def call(*words) -> Said:
    """Run a command line in this process; no traceback ever."""
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
    """Run a command line as a user does, with an interpreter of its own."""
    done = subprocess.run(
        [*PROCESS, *map(str, words)],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "COLUMNS": "200"},
    )
    assert "Traceback" not in done.stderr
    return Said(done.returncode, done.stdout, done.stderr)
