"""Description of a configuration file: its JSON schema, and a template with every option."""

from __future__ import annotations

from typing import Any

import yaml

from flexroad.pipeline.config.cluster import Cluster
from flexroad.pipeline.config.methods import DEFAULTS, HOMES, methods
from flexroad.pipeline.config.models import Export, stage_models
from flexroad.tasks.options import Options


def schema() -> dict[str, Any]:
    """Return the JSON schema of a configuration file, for editors."""
    stages = {stage: model.json_schema() for stage, model in stage_models().items()}
    override = {stage: {"anyOf": [{"type": "string"}, {"type": "object"}]} for stage in stages}
    variant = {"type": ["object", "null"], "properties": override, "additionalProperties": False}
    properties = {
        "extends": {"type": "string", "description": "name of the configuration this one overrides"},
        "dataset": {"type": "object", "description": "a dataset's files: layers, road_values, crs"},
        **stages,
        "export": Export.model_json_schema(),
        "cluster": {"anyOf": [{"type": "string"}, Cluster.model_json_schema()]},
        "variants": {"type": "object", "additionalProperties": variant},
    }
    return {"type": "object", "properties": properties, "additionalProperties": False}


def template() -> str:
    """Return a configuration file with every option at its default, each with its description."""
    lines = ["# Every option with its default. Delete what you do not change."]
    for stage in HOMES:
        default = DEFAULTS.get(stage, "")
        lines += [f"{stage}:", *_option_lines(methods(stage)[default].Options)]
        others = [name for name in methods(stage) if name != default]
        if others:
            lines.append(f"  # other methods: {', '.join(others)}")
    lines += ["export:", *_option_lines(Export), "cluster:", *_option_lines(Cluster)]
    lines += ["variants:", "  flexroad: {}"]
    return "\n".join(lines) + "\n"


def _option_lines(model: type[Options]) -> list[str]:
    lines = []
    for key, field in model.model_fields.items():
        value = field.get_default(call_default_factory=True)
        text = yaml.safe_dump(_plain(value), default_flow_style=True).splitlines()[0]
        meaning = f"  # {' '.join(field.description.split())}" if field.description else ""
        lines.append(f"  {key}: {text}{meaning}")
    return lines


def _plain(value: Any) -> Any:
    return list(value) if isinstance(value, tuple) else value
