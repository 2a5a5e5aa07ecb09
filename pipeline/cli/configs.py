"""``flexroad config``: show configurations."""

from __future__ import annotations

import json
from typing import Annotated

import typer
import yaml

from flexroad.pipeline.cli import options
from flexroad.pipeline.cli.command import Command, group
from flexroad.pipeline.cli.stdio import echo, echo_document
from flexroad.pipeline.config.loading import USUAL, load_config, shipped
from flexroad.pipeline.config.schema import schema, template

app = group("config", "Show configurations.")


@app.command("show", cls=Command)
def config_show(
    name: Annotated[
        str | None,
        typer.Argument(
            metavar="NAME|FILE",
            help=f"A YAML file or a shipped name; default: list the shipped ones, {USUAL} with --set.",
        ),
    ] = None,
    settings: options.Settings = None,
) -> None:
    """Show every option of every variant of a configuration."""
    if name is None and not settings:
        for shipped_name, path in shipped().items():
            echo(f"{shipped_name:10} {path.read_text().splitlines()[0].lstrip('# ')}")
        return
    config = load_config(name or USUAL, settings or ())
    chains = {
        variant: {stage: chosen.model_dump(mode="json") for stage, chosen in chain.items()}
        for variant, chain in config.chains.items()
    }
    sections = {key: getattr(config, key).model_dump(mode="json") for key in ("export", "cluster")}
    echo_document(yaml.safe_dump({**sections, "variants": chains}, sort_keys=False))


@app.command("template")
def config_template() -> None:
    """Print every option with its value in production and its meaning."""
    echo_document(template())


@app.command("schema")
def config_schema() -> None:
    """Print the JSON schema of a configuration, for editors."""
    echo_document(json.dumps(schema(), indent=1))
