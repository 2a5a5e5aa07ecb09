"""The stages of the paper and their modules: one file, or a package with one file per method."""

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
"""Stage -> its module, or the package of its methods if it has several; in the paper's order."""
DEFAULTS = {"segment": "mask", "ecsrc": "paper", "fit": "nurbs"}
"""Default method of each stage that has several."""


@cache
def methods(stage: str) -> dict[str, Any]:
    """Return the modules of a stage by method; the key is ``""`` for a stage with a single method.

    A method's module is NAME.py, or NAME/segment.py for a learned method. Its methods are the values of the
    field ``method`` in its options.
    """
    home: Any = importlib.import_module(HOMES[stage])
    if stage not in DEFAULTS:
        return {"": home}
    modules: dict[str, Any] = {}
    for file in sorted(pkgutil.iter_modules(home.__path__), key=lambda file: file.name):
        name = f"{file.name}.{stage}" if file.ispkg else file.name
        module = importlib.import_module(f"{HOMES[stage]}.{name}")
        modules |= dict.fromkeys(get_args(module.Options.model_fields["method"].annotation), module)
    return modules
