"""Standard output and error: lines without control characters; streams that ignore write errors.

All commands print with `echo` and `echo_document`. File names, ids, tags and messages come from files, and a
terminal would obey the control characters in them.
"""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Iterator, Sequence
from typing import IO, Any

import typer

from flexroad.catalog.text import printable, without_credentials


def echo(line: str, err: bool = False) -> None:
    """Print one line to standard output or error; characters that cannot be printed are escaped.

    Credentials in addresses are hidden on standard error. Data on standard output is unchanged.
    """
    typer.echo(printable(without_credentials(line) if err else line), err=err)


def end_for_steps(faults: Sequence[str], allowed: bool) -> None:
    """Print where tiles do not meet; end with exit code 1 unless ``--allow-steps`` is given."""
    for line in faults:
        echo(f"{'note' if allowed else 'error'}: {line}", err=True)
    if faults and not allowed:
        echo("the files are written; --allow-steps takes them as they are", err=True)
        raise typer.Exit(1)


def echo_document(text: str) -> None:
    """Print a text of several lines to standard output."""
    for line in text.removesuffix("\n").split("\n"):
        echo(line)


class _LenientStream:
    """A text stream that ignores write errors; other attributes come from the wrapped stream."""

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
    """Ignore write errors of this process's standard output and error, which may be None.

    A full disk of the log must not stop a run.
    """
    with (
        contextlib.redirect_stdout(sys.stdout and _LenientStream(sys.stdout)),
        contextlib.redirect_stderr(sys.stderr and _LenientStream(sys.stderr)),
    ):
        yield
