"""The stages of the paper: their modules or packages of methods, inputs, versions and models."""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, get_args

from flexroad.tasks.options import Options, stage_module

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
"""Default method of each stage that has several methods."""
STAGES: dict[str, tuple[str, ...]] = {
    "load": (),
    "segment": ("load",),
    "ecsrc": ("load", "segment"),
    "fit": ("load", "ecsrc"),
    "sample": ("fit", "segment", "ecsrc"),
    "evaluate": ("sample", "load", "segment", "fit"),
    "assess": ("load", "segment", "ecsrc", "fit"),
}
"""Stage -> the stages whose results its function takes, in this order; stages in the paper's order."""
STAGE_NAMES = tuple(STAGES)


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


def stage_version(stage: str, options: Options) -> tuple[str, int]:
    """Return the name of a stage with its method, such as ``fit.nurbs``, and its `VERSION`."""
    method = options.model_dump().get("method")
    return f"{stage}.{method}" if method else stage, stage_module(options).VERSION


def stage_head(stage: str, options: Options) -> list[Any]:
    """Return stage, `VERSION` and options as they enter fingerprints."""
    module = stage_module(options)
    version = [module.VERSION, module.LEVELS_VERSION] if getattr(options, "levels", False) else module.VERSION
    return [stage, version, options.model_dump(mode="json")]


def model_files(options: Options) -> tuple[Path, ...]:
    """Return the files named by the options, such as a model: the result of their module's `files`."""
    files: Callable[[Options], tuple[Path, ...]] = getattr(stage_module(options), "files", lambda _: ())
    return files(options)
