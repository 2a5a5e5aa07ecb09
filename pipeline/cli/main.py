"""``flexroad ...``: the command line. Exit code 0: all done, 1: some tiles failed, 2: nothing could start."""

from __future__ import annotations

import itertools
import os
import sys
from collections.abc import Sequence
from typing import Annotated

import typer

from flexroad.catalog.errors import CatalogError
from flexroad.pipeline.cli.catalogs import catalogs
from flexroad.pipeline.cli.clean import clean
from flexroad.pipeline.cli.configs import configs
from flexroad.pipeline.cli.lifecycle import unread
from flexroad.pipeline.cli.prepare import prepare
from flexroad.pipeline.cli.results import figures, query, report, tables
from flexroad.pipeline.cli.run import rerun, run, status
from flexroad.pipeline.cli.train import train
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
app.command("train")(train)
for command in (run, rerun, status, clean, report, tables, figures, query):
    app.command()(command)

SEVERAL = ("--tile", "--road-value", "--ground-class", "--bridge-class")
"""Options that take several values in a row."""
FOLDER_FIRST = ("rerun", "clean", "figures", "rasters", "nrw")
"""Commands with a folder of their own, which must come first for that."""


def main() -> None:
    """Run the command line; what the user did wrong becomes one line and exit code 2."""
    try:
        app(spread(sys.argv[1:]), standalone_mode=True)
    except (CatalogError, ConfigError) as error:
        for line in str(error).splitlines():
            print(f"error: {line}", file=sys.stderr)  # noqa: T201
        sys.exit(2)
    except SystemExit as ended:
        if ended.code == 2:
            # Everything else that ends with 2 has told the alarm itself.
            unread(sys.argv[1:], lambda line: print(f"warning: {line}", file=sys.stderr))  # noqa: T201
        raise
    except BrokenPipeError:
        # `flexroad ... | head` closed the pipe: no fault of the run.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(0)
    except OSError as error:
        print(f"error: {error}; check the path and the disk, then repeat the command", file=sys.stderr)  # noqa: T201
        sys.exit(2)


def spread(words: Sequence[str]) -> list[str]:
    """Repeat the name of an option before each of its values: ``--tile a b`` -> ``--tile a --tile b``."""
    for command, following in itertools.pairwise(words):
        if command in FOLDER_FIRST and following.startswith("-"):
            # Of `rerun --tile a b`, b is the run.
            return list(words)
    out: list[str] = []
    name = ""
    for word in words:
        if word.startswith("-") and not word.lstrip("-").isdigit():
            name = word if word in SEVERAL else ""
        elif name and out[-1] != name:
            out.append(name)
        out.append(word)
    return out


@app.callback(invoke_without_command=True)
def _root(
    version: Annotated[bool, typer.Option("--version", help="Show the version and stop.")] = False,
) -> None:
    if version:
        import importlib.metadata

        typer.echo(importlib.metadata.version("flexroad"))
        raise typer.Exit
