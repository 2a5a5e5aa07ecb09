"""``flexroad ...``: the command line. Exit code 0: all done, 1: some tiles failed, 2: could not start."""

from __future__ import annotations

import os
import sys
from typing import Annotated

import typer

from flexroad.catalog.errors import CatalogError
from flexroad.catalog.text import one_line
from flexroad.pipeline.cli import limits
from flexroad.pipeline.cli.catalogs import catalogs
from flexroad.pipeline.cli.clean import clean
from flexroad.pipeline.cli.command import Command
from flexroad.pipeline.cli.configs import configs
from flexroad.pipeline.cli.export import export
from flexroad.pipeline.cli.init import init
from flexroad.pipeline.cli.prepare import prepare
from flexroad.pipeline.cli.query import query
from flexroad.pipeline.cli.results import figures, report, tables
from flexroad.pipeline.cli.run import rerun, run, status
from flexroad.pipeline.cli.stdio import echo
from flexroad.pipeline.cli.train import train
from flexroad.pipeline.cli.view import view
from flexroad.pipeline.errors import ConfigError

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
    help="Turn aerial geodata into smooth, light, georeferenced 3D road surfaces, for many tiles at once.",
)
app.add_typer(catalogs, name="catalog")
app.add_typer(prepare, name="prepare")
app.add_typer(configs, name="config")
for command in (init, run, rerun, status, clean, report, query, export, view, tables, figures, train):
    app.command(cls=Command)(command)


def main() -> None:
    """Run the command line; a user error is printed as one line, with exit code 2."""
    limits.raise_open_files()
    # Rasterio loads boto3 where it is installed, for a tenth of the time of a short command. It uses it only
    # for credentials, which GDAL reads by itself.
    sys.modules.setdefault("boto3", None)  # type: ignore[arg-type]
    try:
        app()
    except (CatalogError, ConfigError) as error:
        for line in str(error).splitlines():
            echo(f"error: {line}", err=True)
        sys.exit(2)
    except SystemExit as end:
        # typer ends with 130 without a word. Commands that notice an interruption themselves have said so.
        if isinstance(getattr(end.__context__, "__cause__", None), KeyboardInterrupt):
            echo("interrupted; repeat the command", err=True)
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
    context: typer.Context,
    version: Annotated[bool, typer.Option("--version", help="Show the version and stop.")] = False,
) -> None:
    if version:
        import importlib.metadata

        echo(importlib.metadata.version("flexroad"))
        raise typer.Exit
    limits.check(context.invoked_subcommand)


if __name__ == "__main__":
    main()
