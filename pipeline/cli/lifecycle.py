"""End of a ``run`` or ``rerun`` command: exit code, notification of the operator, Prometheus file."""

from __future__ import annotations

import contextlib
import importlib.metadata
import signal
import socket
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from flexroad.catalog.errors import CatalogError
from flexroad.catalog.storage.paths import Location, absolute
from flexroad.catalog.text import count
from flexroad.pipeline.cli.stdio import echo
from flexroad.pipeline.errors import ConfigError

if TYPE_CHECKING:
    from flexroad.pipeline.run.prometheus import Textfile
    from flexroad.pipeline.run.summary import Summary

CANNOT_START = 2
INTERRUPTED = 130
ON_FAILURE = "FLEXROAD_ON_FAILURE"
"""Environment variable for `--on-failure`: options are visible in the list of processes, it is not."""


@dataclass
class Outcome:
    """Result of a command; filled in while it works."""

    exit_code: int = 0
    text: str = ""
    """The result in one line."""
    summary: Summary | None = None
    """The state of the run; None if no tile was processed."""
    textfile: Textfile | None = None
    """The Prometheus file, called with every tile result; None without ``--prometheus``."""


def format_summary(summary: Summary) -> str:
    """Return the state of a run in one line."""
    parts = [f"{summary.cached} cached"]
    if summary.without_roads:
        parts.append(f"{summary.without_roads} without roads")
    states = f"{summary.done} done ({', '.join(parts)}), {summary.failed} failed, {summary.pending} pending"
    changes = f"{summary.new} new, {summary.changed} changed, {summary.vanished} vanished"
    return f"{count(summary.tiles, 'tile')}: {states}; {changes}; {summary.seconds:.0f} s"


def warn(line: str, kind: str = "warning") -> None:
    """Print a line to standard error."""
    echo(f"{kind}: {line}", err=True)


@contextlib.contextmanager
def report_outcome(run: Location, on_failure: str | None, prometheus: Path | None) -> Iterator[Outcome]:
    """Record how the block ends, in the Prometheus file and, if it fails, in a notification.

    An interruption is recorded and not raised again; all other exceptions are.

    Raises
    ------
    ConfigError
        If the file for Prometheus cannot be written.
    """
    from flexroad.pipeline.run.summary import read_summary

    before = read_summary(run)
    outcome = Outcome()
    with signals_interrupt(), contextlib.ExitStack() as stack:
        # The stack is left in reverse order: the notification follows the Prometheus file.
        stack.callback(_notify, outcome, run, before, on_failure)
        try:
            outcome.textfile = _textfile(stack, run, prometheus)
            yield outcome
        except KeyboardInterrupt:
            outcome.exit_code = INTERRUPTED
            outcome.text = "interrupted; the same command goes on from here"
        except BaseException as error:
            outcome.exit_code, outcome.text = _describe(error)
            raise
        finally:
            if outcome.textfile is not None:
                outcome.textfile.ended(outcome.exit_code, outcome.summary)


def notify_invalid_command(run: Path | None, target: str) -> None:
    """Notify the operator that the command line of a run is invalid."""
    text = "the command line could not be read; `flexroad run --help` shows it"
    _notify(Outcome(CANNOT_START, text), run or Path(), {}, target)


@contextlib.contextmanager
def signals_interrupt() -> Iterator[None]:
    """Raise KeyboardInterrupt at the first SIGINT, SIGTERM or SIGHUP; ignore further ones."""
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    interrupted = False

    def interrupt(*_: object) -> None:
        nonlocal interrupted
        interrupted = True
        for number in before:
            # Shutdown takes seconds. A second signal would interrupt it and leave workers running.
            signal.signal(number, lambda *_: None)
        raise KeyboardInterrupt

    for number, handler in before.items():
        # Background processes and nohup ignore SIGINT or SIGHUP: these stay ignored.
        if number == signal.SIGTERM or handler is not signal.SIG_IGN:
            signal.signal(number, interrupt)
    try:
        yield
    finally:
        for number, handler in before.items():
            # After an interruption a late signal must not change the exit code.
            signal.signal(number, signal.SIG_IGN if interrupted else handler)


def _textfile(stack: contextlib.ExitStack, run: Location, path: Path | None) -> Textfile | None:
    if path is None:
        return None
    from flexroad.pipeline.run.prometheus import Textfile

    try:
        return stack.enter_context(Textfile(path, str(absolute(run))))
    except OSError as error:
        raise ConfigError(f"cannot write --prometheus {path}: {error.strerror or error}") from error


def _describe(error: BaseException) -> tuple[int, str]:
    """Return the exit code and the text for an exception."""
    if isinstance(error, CatalogError | ConfigError | OSError):
        return CANNOT_START, f"could not start: {error}"
    return 1, f"{type(error).__name__}: {error}"


def _notify(outcome: Outcome, run: Location, before: dict[str, Any], target: str | None) -> None:
    """Send the outcome to the target if the exit code is not 0."""
    if not target or not outcome.exit_code:
        return
    from flexroad.pipeline.run.alerts import notify
    from flexroad.pipeline.run.summary import read_summary

    after = read_summary(run)
    message = {
        # Chat services show this key.
        "text": f"flexroad {run} on {socket.gethostname()}: {outcome.text}",
        # An unchanged summary belongs to an earlier run.
        **(after if after != before else {}),
        "run": str(run),
        "host": socket.gethostname(),
        "flexroad": importlib.metadata.version("flexroad"),
        "exit_code": outcome.exit_code,
    }
    if reason := notify(target, message):
        warn(f"--on-failure: {reason}")
