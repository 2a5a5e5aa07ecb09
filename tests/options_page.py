"""The page docs/options.md, from the models that hold the options: ``python -m tests.options_page``."""

from __future__ import annotations

from pathlib import Path

import yaml
from pydantic import BaseModel
from pydantic.fields import FieldInfo

from flexroad.pipeline.config.models import Cluster, Export
from flexroad.pipeline.config.stages import DEFAULTS, HOMES, methods

PAGE = Path(__file__).parents[1] / "docs" / "options.md"
HEAD = """# Options

The options of a configuration with their own defaults (`extends: defaults`), bounds and meaning. `flexroad
config template` prints the values of `production`, `flexroad config show NAME` the values of a configuration,
`flexroad config schema` a schema for editors.
"""
BOUNDS = {"ge": "at least", "gt": "above", "le": "at most", "lt": "below"}


def page() -> str:
    """Return the text of the page."""
    parts = [HEAD]
    for stage in HOMES:
        parts.append(f"## {stage}\n")
        modules = methods(stage)
        for model in dict.fromkeys(module.Options for module in modules.values()):
            names = [name for name, module in modules.items() if module.Options is model]
            if names == [""]:
                parts.append(rows(model))
            else:
                default = ", the default" if DEFAULTS[stage] in names else ""
                title = f"`method: {'` or `'.join(names)}`{default}"
                parts.append(f"{title}\n\n{rows(model, without='method')}")
    parts += [f"## {name}\n\n{rows(part)}" for name, part in (("export", Export), ("cluster", Cluster))]
    return "\n".join(parts)


def rows(model: type[BaseModel], without: str = "") -> str:
    """Return a line for each option of a model."""
    lines = [row(name, field) for name, field in model.model_fields.items() if name != without]
    return "\n".join(lines or ["No options."]) + "\n"


def row(name: str, field: FieldInfo) -> str:
    meaning = " ".join((field.description or "").split())
    value = field.get_default(call_default_factory=True)
    if field.is_required():
        return f"- `{name}` (required): {meaning}"
    plain = [*value] if isinstance(value, tuple) else value
    text = yaml.safe_dump(plain, default_flow_style=True, width=1000).splitlines()[0]
    bounds = [
        f"{word} {getattr(mark, key):,.10g}"
        for mark in field.metadata
        for key, word in BOUNDS.items()
        if hasattr(mark, key)
    ]
    limits = f" ({', '.join(bounds)})" if bounds else ""
    return f"- `{name}: {text}`{limits}: {meaning}"


if __name__ == "__main__":
    PAGE.write_text(page())
