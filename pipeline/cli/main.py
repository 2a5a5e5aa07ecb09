"""``flexroad ...``: the command line. Exit code 0: all done, 1: some tiles failed, 2: could not start."""

from __future__ import annotations

import importlib.metadata
import os
import sys
from typing import Annotated, Any

import typer

from flexroad.catalog.errors import CatalogError
from flexroad.catalog.text import one_line
from flexroad.pipeline import IGNORED
from flexroad.pipeline.cli import limits
from flexroad.pipeline.cli.command import LazyGroup
from flexroad.pipeline.cli.signals import INTERRUPTED, signals_interrupt
from flexroad.pipeline.cli.stdio import echo
from flexroad.pipeline.errors import ConfigError

COMMANDS = {
    "init": ("tools.check.command", "List the downloads in a folder, and the commands for them."),
    "run": ("pipeline.cli.run", "Bring every tile of a run up to date."),
    "rerun": ("pipeline.cli.run", "Bring tiles of a run up to date again."),
    "status": ("pipeline.cli.run", "Show the state of a run and the failures of its tiles."),
    "clean": ("pipeline.cli.clean", "Delete files that no run needs."),
    "report": ("tools.report.command", "Write a report on a run: failures, places, figures."),
    "query": ("tools.results.command", "Print heights, classes and flags at points or along lines."),
    "lift": ("tools.lift.command", "Write a road network or features with heights of a run."),
    "export": ("tools.export.command", "Write finished tiles in the formats of other programs."),
    "view": ("tools.view.command", "Write a run as a page for browsers: map and surface in 3D."),
    "tables": ("tools.reproduce.command", "Write the paper's tables and claims beside the values of a run."),
    "figures": ("tools.reproduce.command", "Draw the paper's figures from a run."),
    "train": ("tools.train.command", "Train the head of `segment: dinov2` on labelled tiles."),
    "catalog": ("pipeline.cli.catalogs", "Make, show and check catalogs of tiles."),
    "prepare": ("tools.prepare.command", "Make rasters and a catalog from points, meshes or photographs."),
    "config": ("pipeline.cli.configs", "Show configurations."),
}
"""The module of each command and the first line of its help (`LazyGroup.modules`)."""


class Commands(LazyGroup):
    """The commands of the program."""

    modules = COMMANDS

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """Return a command, None if it does not exist, after a check of the limits of this process."""
        limits.check(cmd_name)
        return super().get_command(ctx, cmd_name)


app = typer.Typer(
    cls=Commands,
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
    help="Turn aerial geodata into smooth, light, georeferenced 3D road surfaces, for many tiles at once.",
)


def main() -> None:
    """Run the command line; a user error is printed as one line, with exit code 2."""
    limits.raise_open_files()
    if IGNORED:
        echo(f"warning: {IGNORED}", err=True)
    # If boto3 is installed, rasterio loads it, in a tenth of the time of a short command. Rasterio needs it
    # only for credentials, which GDAL reads by itself.
    sys.modules.setdefault("boto3", None)  # type: ignore[arg-type]
    try:
        with signals_interrupt():
            app()
    except (CatalogError, ConfigError) as error:
        for line in str(error).splitlines():
            echo(f"error: {line}", err=True)
        sys.exit(2)
    except (SystemExit, KeyboardInterrupt) as end:
        # typer ends with 130 without a message. Commands that handle an interruption print their own message.
        cause = getattr(end.__context__, "__cause__", None)
        if isinstance(end, KeyboardInterrupt) or isinstance(cause, KeyboardInterrupt):
            echo("interrupted; repeat the command", err=True)
            sys.exit(INTERRUPTED)
        raise
    except Exception as error:
        reason = _reason(error)
        if reason is None:
            raise
        echo(f"error: {reason}", err=True)
        sys.exit(2)
    finally:
        for stream in filter(None, (sys.stdout, sys.stderr)):
            try:
                stream.flush()
            except OSError:
                # With a full disk or a closed pipe, the flush at exit would fail and change the exit code.
                os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def _reason(error: Exception) -> str | None:
    """Return the message for an error of the machine or the installation; None for other errors."""
    if reason := limits.memory_reason(error):
        return reason
    if isinstance(error, OSError):
        return f"{error}; {limits.remedy(error)}, then repeat the command"
    if isinstance(error, ImportError):
        return f"a library cannot be loaded: {one_line(error)}; install flexroad and its libraries again"
    return None


def _show_version(wanted: bool) -> None:
    if wanted:
        echo(importlib.metadata.version("flexroad"))
        raise typer.Exit


@app.callback()
def _root(
    allow: Annotated[
        list[str] | None,
        typer.Option(metavar="FOLDER|URL", help="Allow source files in this folder, too; repeatable."),
    ] = None,
    version: Annotated[
        bool,
        typer.Option("--version", help="Show the version and stop.", callback=_show_version, is_eager=True),
    ] = False,
) -> None:
    """Take the options of all commands: `options.allowed` reads them."""


if __name__ == "__main__":
    main()
