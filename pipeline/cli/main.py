"""``flexroad ...``: the command line. Exit code 0: all done, 1: some tiles failed, 2: could not start."""

from __future__ import annotations

import functools
import importlib
import importlib.metadata
import os
import sys
from typing import Annotated, Any

import typer
from typer.core import TyperCommand, TyperGroup

from flexroad.catalog.errors import CatalogError
from flexroad.catalog.text import one_line
from flexroad.pipeline import IGNORED
from flexroad.pipeline.cli import limits
from flexroad.pipeline.cli.signals import INTERRUPTED, signals_interrupt
from flexroad.pipeline.cli.stdio import echo
from flexroad.pipeline.errors import ConfigError

COMMANDS = {
    "init": ("init", "Say what a folder of downloads has, and which commands fit."),
    "run": ("run", "Bring every tile of a run up to date."),
    "rerun": ("run", "Bring tiles of a run up to date again."),
    "status": ("run", "Show the state of a run and the failures of its tiles."),
    "clean": ("clean", "Delete files that no run needs."),
    "report": ("results", "Write a report on a run: failures, places, figures."),
    "query": ("query", "Print heights, classes and flags at points or along lines."),
    "lift": ("lift", "Write a road network or features with heights of a run."),
    "export": ("export", "Write finished tiles in the formats of other programs."),
    "view": ("view", "Write a run as a page for browsers: map and surface in 3D."),
    "tables": ("results", "Write the paper's tables and claims beside the values of a run."),
    "figures": ("results", "Draw the paper's figures from a run."),
    "train": ("train", "Train the head of `segment: dinov2` on labelled tiles."),
    "catalog": ("catalogs", "Make, show and check catalogs of tiles."),
    "prepare": ("prepare", "Make rasters and a catalog of points, meshes or photographs."),
    "config": ("configs", "Show configurations."),
}
"""The module of each command, whose `app` has it, and the first line of its help."""


class Commands(TyperGroup):
    """The commands of the program; the module of a command is imported when the command is called."""

    def __init__(self, **attributes: Any) -> None:
        super().__init__(**attributes)
        self.commands = {name: TyperCommand(name, help=text) for name, (_, text) in COMMANDS.items()}

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """Return a command, None if there is no such one; the limits of this process suffice for it."""
        limits.check(cmd_name)
        return _imported(cmd_name) if cmd_name in COMMANDS else None

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write the list of commands of the help page, without importing them."""
        TyperGroup(commands=dict(self.commands)).format_commands(ctx, formatter)


@functools.cache
def _imported(name: str) -> Any:
    group = typer.main.get_group(importlib.import_module(f"flexroad.pipeline.cli.{COMMANDS[name][0]}").app)
    return group if group.name == name else group.commands[name]


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
    # Rasterio loads boto3 where it is installed, for a tenth of the time of a short command. It uses it only
    # for credentials, which GDAL reads by itself.
    sys.modules.setdefault("boto3", None)  # type: ignore[arg-type]
    try:
        with signals_interrupt():
            app()
    except (CatalogError, ConfigError) as error:
        for line in str(error).splitlines():
            echo(f"error: {line}", err=True)
        sys.exit(2)
    except (SystemExit, KeyboardInterrupt) as end:
        # typer ends with 130 without a word. Commands that notice an interruption themselves have said so.
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
                # A full disk or a closed pipe: the flush at exit would fail and change the exit code.
                os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def _reason(error: Exception) -> str | None:
    """Return what to print of an error that comes from the machine or the installation; None of others."""
    if reason := limits.memory_reason(error):
        return reason
    if isinstance(error, OSError):
        return f"{error}; {limits.remedy(error)}, then repeat the command"
    if isinstance(error, ImportError):
        return f"a library cannot be loaded: {one_line(error)}; install flexroad and its libraries again"
    return None


@app.callback(invoke_without_command=True)
def _root(
    version: Annotated[bool, typer.Option("--version", help="Show the version and stop.")] = False,
) -> None:
    if version:
        echo(importlib.metadata.version("flexroad"))
        raise typer.Exit


if __name__ == "__main__":
    main()
