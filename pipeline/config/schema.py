"""Description of a configuration file: its JSON schema, and a template with every option."""

from __future__ import annotations

from typing import Any

import yaml

from flexroad.pipeline.config.cluster import Cluster
from flexroad.pipeline.config.loading import USUAL, load_config
from flexroad.pipeline.config.methods import methods
from flexroad.pipeline.config.models import ROOT, Export, stage_models
from flexroad.tasks.options import Options

EXTENDS = f"the configuration that this one overrides; {ROOT}: none, so that options have their own defaults"


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
        text = yaml.safe_dump(_plain(getattr(options, key)), default_flow_style=True).splitlines()[0]
        meaning = f"  # {' '.join(field.description.split())}" if field.description else ""
        lines.append(f"  {key}: {text}{meaning}")
    return lines


def _plain(value: Any) -> Any:
    return list(value) if isinstance(value, tuple) else value
