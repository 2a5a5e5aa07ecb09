"""``flexroad config``: show configurations, their JSON schema, and a template with every option."""

from __future__ import annotations

import json
from typing import Annotated, Any

import typer
import yaml

from flexroad.pipeline.cli import options
from flexroad.pipeline.cli.command import Command, group
from flexroad.pipeline.cli.stdio import echo, echo_document
from flexroad.pipeline.config.loading import USUAL, load_config, shipped
from flexroad.pipeline.config.models import ROOT, Cluster, Export, stage_models
from flexroad.pipeline.config.stages import methods
from flexroad.tasks.options import Options

app = group("config", "Show configurations.")

EXTENDS = f"the configuration that this file overrides; {ROOT}: no configuration, only the options' defaults"


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


def schema() -> dict[str, Any]:
    """Return the JSON schema of a configuration file, for editors."""
    stages = {stage: model.json_schema() for stage, model in stage_models().items()}
    override = {stage: {"anyOf": [{"type": "string"}, {"type": "object"}]} for stage in stages}
    variant = {"type": ["object", "null"], "properties": override, "additionalProperties": False}
    properties = {
        "extends": {"type": "string", "default": USUAL, "description": EXTENDS},
        "dataset": {"type": "object", "description": "a dataset's files: layers, road_values, crs"},
        **stages,
        "export": Export.model_json_schema(),
        "cluster": {"anyOf": [{"type": "string"}, Cluster.model_json_schema()]},
        "variants": {"type": "object", "additionalProperties": variant},
    }
    return {"type": "object", "properties": properties, "additionalProperties": False}


def template() -> str:
    """Return a configuration file with every option of `USUAL`, each with its description."""
    config = load_config(USUAL)
    (chain,) = config.chains.values()
    lines = [f"# Every option with its value in {USUAL}. Delete what you do not change.", f"extends: {USUAL}"]
    for stage, chosen in chain.items():
        lines += [f"{stage}:", *_option_lines(chosen)]
        others = [name for name in methods(stage) if name != getattr(chosen, "method", "")]
        if others:
            lines.append(f"  # other methods: {', '.join(others)}")
    lines += ["export:", *_option_lines(config.export), "cluster:", *_option_lines(config.cluster)]
    lines += ["variants:", *(f"  {variant}: {{}}" for variant in config.chains)]
    return "\n".join(lines) + "\n"


def _option_lines(options: Options) -> list[str]:
    lines = []
    for key, field in type(options).model_fields.items():
        value = getattr(options, key)
        plain = list(value) if isinstance(value, tuple) else value
        text = yaml.safe_dump(plain, default_flow_style=True).splitlines()[0]
        meaning = f"  # {' '.join(field.description.split())}" if field.description else ""
        lines.append(f"  {key}: {text}{meaning}")
    return lines
