"""A process that reads damaged files one after the other, since a fault may end it.

It reads the names of files from standard input, calls a function with each, and answers with one line of
JSON.
"""

import contextlib
import importlib
import json
import os
import resource
import selectors
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

START = "from tests.fuzz.reader import main; main()"
ROOT = Path(__file__).parents[2]
SECONDS = 30
"""Limit of one file; most take milliseconds, but the machine may be busy."""
START_SECONDS = 300
"""Limit of the imports; they take some seconds, on a busy machine many."""
MEMORY = 4 * 2**30
"""Limit of the process (bytes)."""
MAX_LINE = 2000


@dataclass(frozen=True)
class Result:
    """What came of reading one file."""

    path: Path
    fault: str
    """Traceback, hang or end of the process, or empty."""
    message: str
    """The error's line, or empty if the file was read."""

    @property
    def was_read(self) -> bool:
        return not self.fault and not self.message


class Reader:
    """The parent's side of the process."""

    def __init__(self, module: str, function: str) -> None:
        self._command = [sys.executable, "-c", START, module, function]
        self._process: subprocess.Popen[bytes] | None = None
        # Libraries warn of most damaged files.
        self._printed = tempfile.TemporaryFile()  # noqa: SIM115

    def __enter__(self) -> "Reader":
        return self

    def __exit__(self, *_: object) -> None:
        self._end()
        self._printed.close()

    def read(self, path: Path) -> Result:
        """Read a file; after a fault the process is started again."""
        if self._process is None:
            self._process = subprocess.Popen(
                self._command,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=self._printed,
                cwd=ROOT,
                bufsize=0,
            )
            assert self._line(START_SECONDS) == b"ready\n"
        assert self._process.stdin is not None
        self._process.stdin.write(f"{path}\n".encode())
        line = self._line(SECONDS)
        if line:
            fault, message = json.loads(line)
            return Result(path, fault, message)
        code = self._end()
        if code is None:
            return Result(path, f"hang of {SECONDS} s", "")
        return Result(path, f"end of the process: {code} {self._last_words()}", "")

    def _last_words(self) -> str:
        self._printed.seek(0)
        return " ".join(self._printed.read()[-500:].decode(errors="replace").split())

    def _line(self, seconds: float) -> bytes:
        """Return the next line; empty if none comes in time, or the process has ended."""
        assert self._process is not None
        assert self._process.stdout is not None
        with selectors.DefaultSelector() as selector:
            selector.register(self._process.stdout, selectors.EVENT_READ)
            if not selector.select(seconds):
                return b""
        return self._process.stdout.readline()

    def _end(self) -> int | None:
        """End the process; return its exit code, None if it was still alive."""
        if self._process is None:
            return None
        process, self._process = self._process, None
        with contextlib.suppress(OSError):
            process.stdin.close()  # type: ignore[union-attr]
        with contextlib.suppress(subprocess.TimeoutExpired):
            return process.wait(1)
        process.kill()
        process.wait()
        return None


def attempt(read: Callable[[Path], Any], path: Path) -> tuple[str, str]:
    """Read a file; return the fault and the message."""
    from flexroad.catalog import CatalogError
    from flexroad.pipeline.errors import ConfigError
    from flexroad.tasks import TaskError

    try:
        read(path)
    except (CatalogError, ConfigError, TaskError) as error:
        message = str(error)
        # A configuration has one line per mistake.
        lines = message.split("\n") if isinstance(error, ConfigError) else [message]
        if any("\n" in line or len(line) > MAX_LINE for line in lines):
            return f"{type(error).__name__} that is no line: {message[:200]!r}", ""
        return "", message or "no message"
    except Exception as error:
        return f"{type(error).__name__}: {str(error)[:500]}", ""
    return "", ""


def _loop(read: Callable[[Path], Any]) -> None:
    # Libraries may print.
    with os.fdopen(os.dup(1), "w", buffering=1) as answers:
        os.dup2(2, 1)
        answers.write("ready\n")
        for line in sys.stdin:
            answers.write(json.dumps(attempt(read, Path(line.rstrip("\n")))) + "\n")


def main() -> None:
    """Read files in this process, by the function that the command line names."""
    resource.setrlimit(resource.RLIMIT_DATA, (MEMORY, MEMORY))
    _loop(getattr(importlib.import_module(sys.argv[1]), sys.argv[2]))
