"""End of a ``run`` or ``rerun`` command: exit code, notification of the operator, Prometheus file."""

from __future__ import annotations

import contextlib
import importlib.metadata
import socket
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import typer

from flexroad.catalog.errors import CatalogError
from flexroad.catalog.storage.paths import Location, absolute
from flexroad.catalog.text import count, without_credentials
from flexroad.pipeline.cli.command import Command
from flexroad.pipeline.cli.signals import INTERRUPTED, signals_interrupt
from flexroad.pipeline.cli.stdio import echo
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.run.alerts import notify
from flexroad.pipeline.run.prometheus import Textfile
from flexroad.pipeline.run.summary import Summary, read_summary

CANNOT_START = 2


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
    left_out = _left_out(summary)
    seconds = f"{summary.seconds:.0f} s{summary.to_look_at}"
    return f"{count(summary.tiles, 'tile')}: {states}; {changes}{left_out}; {seconds}"


def _left_out(summary: Summary) -> str:
    """Return what the catalog skipped for that line, empty if it is nothing."""
    if not summary.skipped:
        return ""
    lost = f", {count(summary.lost, 'tile')} lost" if summary.lost else ""
    return f"; {count(summary.skipped, 'file')} skipped by the catalog{lost}"


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
    before = read_summary(run)
    outcome = Outcome()
    with contextlib.ExitStack() as stack:
        # The stack is left in reverse order: the notification follows the Prometheus file.
        stack.callback(_notify, outcome, run, before, on_failure)
        try:
            with signals_interrupt():
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


class RunCommand(Command):
    """A command with --on-failure, which also gets a notification if the command line is invalid."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse the words of a command line."""
        try:
            return super().parse_args(ctx, args)
        except typer.TyperException:
            # Resilient parsing returns the valid options and raises nothing.
            lenient = {"resilient_parsing": True, "ignore_unknown_options": True}
            params = self.make_context(ctx.info_name, [*args], ctx.parent, **lenient).params
            if target := params.get("on_failure"):
                text = "the command line could not be read; `flexroad run --help` shows it"
                run = params.get("out") or params.get("path") or Path()
                _notify(Outcome(CANNOT_START, text), run, {}, target)
            raise


def _textfile(stack: contextlib.ExitStack, run: Location, path: Path | None) -> Textfile | None:
    if path is None:
        return None
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
    after = read_summary(run)
    message = {
        # Chat services show this key.
        "text": without_credentials(f"flexroad {run} on {socket.gethostname()}: {outcome.text}"),
        # An unchanged summary belongs to an earlier run.
        **(after if after != before else {}),
        "run": without_credentials(str(run)),
        "host": socket.gethostname(),
        "flexroad": importlib.metadata.version("flexroad"),
        "exit_code": outcome.exit_code,
    }
    if reason := notify(target, message):
        warn(f"--on-failure: {reason}")
