"""``flexroad train``: train the head of `segment: dinov2` on labelled tiles."""

from __future__ import annotations

import shlex
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import typer

from flexroad.catalog import Catalog
from flexroad.catalog.index import check_allowed
from flexroad.catalog.storage.outputs import output_file
from flexroad.catalog.storage.paths import check_writable
from flexroad.catalog.text import printable, shown
from flexroad.pipeline.cli import options as shared
from flexroad.pipeline.cli.command import Command, group
from flexroad.pipeline.cli.stdio import echo
from flexroad.pipeline.config import document
from flexroad.pipeline.config.loading import load_config
from flexroad.pipeline.config.options import INPUTS, METHOD, OUTPUTS
from flexroad.pipeline.errors import ConfigError
from flexroad.tasks.errors import TaskError
from flexroad.tools.train import driver as training
from flexroad.tools.train.report import summary, verdict, write_model

app = group()


@app.command(cls=Command)
@shared.with_options
def train(
    ctx: typer.Context,
    catalog: shared.CatalogFile,
    options: training.TrainOptions,
    output: Annotated[
        Path,
        typer.Option(
            "-o",
            "--output",
            metavar="MODEL",
            help="Model file; the report is written next to it.",
            rich_help_panel=OUTPUTS,
        ),
    ],
    config: Annotated[
        str,
        typer.Option(
            metavar="NAME|FILE",
            help="Configuration with the options of load and segment.",
            rich_help_panel=INPUTS,
        ),
    ] = "paper",
    settings: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="KEY=VALUE",
            help="Option of the training (epochs=100) or the configuration (load.halo_m=0); repeatable.",
            rich_help_panel=METHOD,
        ),
    ] = None,
) -> None:
    """Train the head of `segment: dinov2` on labelled tiles.

    It is validated on other tiles. The files are MODEL, its report MODEL.html, and MODEL.json.
    """
    # Options of the training have no stage and no dot in their names.
    changes = [text for text in settings or () if "." in text.partition("=")[0]]
    own = [text for text in settings or () if text not in changes]
    options = replace(options, settings=_settings(own))
    tiles, loaded_config = Catalog.read(catalog, shared.allowed(ctx)), load_config(config, changes)
    check_allowed(tiles)
    output.parent.mkdir(parents=True, exist_ok=True)
    check_writable(output.parent)
    # Checked before the training, and not only after it.
    for suffix in ("", ".html", ".json"):
        output_file(output.with_name(output.name + suffix))
    try:
        outcome = training.train(tiles, loaded_config, options, lambda line: echo(line, err=True))
        model, page, _ = write_model(outcome, output)
    except TaskError as error:
        raise ConfigError(str(error)) from error
    for note in outcome.notes:
        echo(f"note: {note}", err=True)
    echo(f"{model}: {summary(outcome)}")
    echo(f"report: {page}")
    if warning := verdict(outcome):
        echo(f"warning: {warning}", err=True)
    else:
        echo(f"next: in a configuration, segment: {{method: dinov2, model: {shlex.quote(str(model))}}}")


def _settings(assignments: list[str]) -> dict[str, Any]:
    """Return the settings by name; values are parsed as YAML."""
    parsed: dict[str, Any] = {}
    for assignment in assignments:
        name, equals, value = assignment.partition("=")
        if not equals:
            raise ConfigError(f"--set {shown(assignment)}: give KEY=VALUE, like --set epochs=100")
        given = value.encode(errors="surrogateescape")
        parsed[name], _ = document.parse(given, f"--set {printable(name)}")
    return parsed
