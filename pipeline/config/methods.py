"""The steps of the paper and the files that do them: one file, or a folder with one file per method."""

from __future__ import annotations

import importlib
import pkgutil
from functools import cache
from typing import Any, get_args

HOMES = {
    "load": "flexroad.tasks.load",
    "segment": "flexroad.tasks.segment",
    "ecsrc": "flexroad.tasks.filter",
    "fit": "flexroad.tasks.fit",
    "sample": "flexroad.tasks.sample",
    "evaluate": "flexroad.tasks.metrics.evaluate",
    "assess": "flexroad.tasks.quality.assess",
}
"""The module of each stage, in the paper's order; of a stage with several methods, their package."""
DEFAULTS = {"segment": "mask", "ecsrc": "paper", "fit": "nurbs"}
"""Methods of the stages that have several, where a file names none."""
NO_METHODS = ("kit", "training_types")
"""What lies in a package of methods beside them."""


@cache
def methods(stage: str) -> dict[str, Any]:
    """Return the modules of a stage by method; of a stage with one way to do it, that one under ``""``.

    A method's module is NAME.py, or NAME/segment.py of one that learns; the option ``method`` of its model
    tells the methods.
    """
    home: Any = importlib.import_module(HOMES[stage])
    if stage not in DEFAULTS:
        return {"": home}
    found: dict[str, Any] = {}
    for file in sorted(pkgutil.iter_modules(home.__path__), key=lambda file: file.name):
        if file.name not in NO_METHODS:
            name = f"{file.name}.{stage}" if file.ispkg else file.name
            module = importlib.import_module(f"{HOMES[stage]}.{name}")
            found |= dict.fromkeys(get_args(module.Options.model_fields["method"].annotation), module)
    return found
