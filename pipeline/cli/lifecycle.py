"""How a command about a run ends, and who is told: exit code, operator's alarm, file for Prometheus."""

from __future__ import annotations

import contextlib
import importlib.metadata
import signal
import socket
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from flexroad.catalog.errors import CatalogError
from flexroad.catalog.storage.paths import Location, absolute
from flexroad.pipeline.errors import ConfigError

if TYPE_CHECKING:
    from flexroad.pipeline.monitor.prometheus import Textfile
    from flexroad.pipeline.run.summary import Summary

CANNOT_START = 2
INTERRUPTED = 130
ON_FAILURE = "FLEXROAD_ON_FAILURE"
"""Says the same as `--on-failure`: an address may be a secret, which the list of processes shows to all."""


@dataclass
class Outcome:
    """How it ends; whoever does the work fills it in."""

    exit_code: int = 0
    text: str = ""
    """In one line, for people."""
    how: Summary | None = None
    textfile: Textfile | None = None
    """Told of every tile, if it is wanted."""


def format_summary(how: Summary) -> str:
    """Return how a run stands in one line."""
    now = f"{how.done} done ({how.cached} cached), {how.failed} failed, {how.pending} pending"
    since = f"{how.new} new, {how.changed} changed, {how.vanished} vanished"
    return f"{how.tiles} tiles: {now}; {since}; {how.seconds:.0f} s"


def warn(line: str, kind: str = "warning") -> None:
    """Print a line beside the results, on standard error."""
    typer.echo(f"{kind}: {line}", err=True)


@contextlib.contextmanager
def supervised(run: Location, on_failure: str | None, prometheus: Path | None) -> Iterator[Outcome]:
    """See to it that whatever ends the work inside is told to those who asked to be.

    An interruption ends here; everything else goes on.

    Raises
    ------
    ConfigError
        If the file for Prometheus cannot be written.
    """
    from flexroad.pipeline.run.summary import read_summary

    before = read_summary(run)
    ending = Outcome()
    with _end_as_ctrl_c(), contextlib.ExitStack() as stack:
        # Leaves in the opposite order: the alarm rings when the file is written.
        stack.callback(_alarm, ending, run, before, on_failure)
        try:
            ending.textfile = _textfile(stack, run, prometheus)
            yield ending
        except KeyboardInterrupt:
            ending.exit_code = INTERRUPTED
            ending.text = "interrupted; the same command goes on from here"
        except BaseException as error:
            ending.exit_code, ending.text = _told_by(error)
            raise
        finally:
            if ending.textfile is not None:
                ending.textfile.ended(ending.exit_code, ending.how)


def unread(run: Path | None, target: str) -> None:
    """Tell the alarm that the command line of a run could not be read."""
    text = "the command line could not be read; `flexroad run --help` shows it"
    _alarm(Outcome(CANNOT_START, text), run or Path(), {}, target)


@contextlib.contextmanager
def _end_as_ctrl_c() -> Iterator[None]:
    """Let an operator's `kill`, or a terminal that goes away, end it as Ctrl-C does; the first one counts."""
    before = {which: signal.getsignal(which) for which in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    heard = False

    def interrupt(*_: object) -> None:
        nonlocal heard
        heard = True
        for which in before:
            # The ending takes seconds. Whoever cannot wait would make it longer, and leave workers behind.
            signal.signal(which, lambda *_: None)
        raise KeyboardInterrupt

    for which, handler in before.items():
        # Who started it in the background or with nohup wants it to go on.
        if which == signal.SIGTERM or handler is not signal.SIG_IGN:
            signal.signal(which, interrupt)
    try:
        yield
    finally:
        for which, handler in before.items():
            # The process is about to end with its exit code; an impatient signal must not give it another.
            signal.signal(which, signal.SIG_IGN if heard else handler)


def _textfile(stack: contextlib.ExitStack, run: Location, path: Path | None) -> Textfile | None:
    if path is None:
        return None
    from flexroad.pipeline.monitor.prometheus import Textfile

    try:
        return stack.enter_context(Textfile(path, str(absolute(run))))
    except OSError as error:
        raise ConfigError(f"cannot write --prometheus {path}: {error.strerror or error}") from error


def _told_by(error: BaseException) -> tuple[int, str]:
    if isinstance(error, CatalogError | ConfigError | OSError):
        return CANNOT_START, f"could not start: {error}"
    return 1, f"{type(error).__name__}: {error}"


def _alarm(ending: Outcome, run: Location, before: dict[str, Any], target: str | None) -> None:
    if not target or not ending.exit_code:
        return
    from flexroad.pipeline.monitor.alerts import notify
    from flexroad.pipeline.run.summary import read_summary

    now = read_summary(run)
    told = {
        # What web addresses of chats show.
        "text": f"flexroad {run} on {socket.gethostname()}: {ending.text}",
        # Of an earlier run it would mislead.
        **(now if now != before else {}),
        "run": str(run),
        "host": socket.gethostname(),
        "flexroad": importlib.metadata.version("flexroad"),
        "exit_code": ending.exit_code,
    }
    if why := notify(target, told):
        warn(f"--on-failure: {why}")
