"""Compose the stages' option models into one configuration; the only reader of configs.

A configuration holds one set of options per stage, and variants: named overrides of them. A variant is
never a code path, only other options for the same chain of stages. A stage given as a bare word means its
method: ``fit: plane`` is ``fit: {method: plane}``.
"""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Mapping
from functools import cache
from typing import Annotated, Any, Literal, Union, get_args

from pydantic import BaseModel, Field, TypeAdapter

from flexroad.pipeline.config.cluster import Cluster
from flexroad.tasks import load, sample
from flexroad.tasks.metrics import evaluate
from flexroad.tasks.options import Options
from flexroad.tasks.quality import assess

TAG = {"segment": "method", "ecsrc": "method", "fit": "method", "sample": "method", "cluster": "kind"}
"""The option that a bare word stands for, by stage or section."""


NO_METHODS = ("kit", "training_types")
"""What lies in a package of methods beside them."""


Chain = Mapping[str, Options]
"""The options of one variant, by stage, in the paper's order."""


Format = Literal["glb", "ply", "cog", "npz"]


class Export(Options):
    """What is written for the user, beside the metrics."""

    variants: tuple[str, ...] = Field(
        ("flexroad",),
        min_length=1,
        description="variants whose meshes are kept; query asks the first",
    )
    formats: tuple[Format, ...] = Field(
        ("glb", "ply", "cog", "npz"),
        description="glb and ply: the mesh; cog: height and road mask; npz: the NURBS surface itself",
    )


class Config(BaseModel):
    """A whole run: the chain of every variant, what is exported, and who works."""

    model_config = {"frozen": True, "arbitrary_types_allowed": True}

    name: str
    chains: dict[str, dict[str, Any]]
    """Variant -> stage -> options (`Options`), in the file's and the paper's order."""
    export: Export
    cluster: Cluster
    dataset: dict[str, Any]
    """Where a published dataset's files lie: for `catalog.sources`, which checks it."""
    raw: dict[str, Any]
    """The resolved file, as written to the run's config.yaml."""


@cache
def methods(package: str) -> dict[str, Any]:
    """Return the stage files of a package by method: NAME.py, or NAME/segment.py of one that learns."""
    home = importlib.import_module(package)
    stage = package.rpartition(".")[2]
    found: dict[str, Any] = {}
    for file in sorted(pkgutil.iter_modules(home.__path__), key=lambda file: file.name):
        if file.name not in NO_METHODS:
            module = importlib.import_module(f"{package}.{file.name}{f'.{stage}' if file.ispkg else ''}")
            found |= dict.fromkeys(get_args(module.Options.model_fields["method"].annotation), module)
    return found


@cache
def stage_models() -> dict[str, TypeAdapter[Options]]:
    """Return what validates the options of each stage, in the paper's order."""

    def one_of(package: str) -> TypeAdapter[Options]:
        models: Any = tuple(dict.fromkeys(module.Options for module in methods(package).values()))
        if len(models) == 1:
            return TypeAdapter(models[0])
        union: Any = Union[models]  # noqa: UP007 (which models there are is known only now)
        chosen: Any = Annotated[union, Field(discriminator="method")]
        return TypeAdapter(chosen)

    return {
        "load": TypeAdapter(load.Options),
        "segment": one_of("flexroad.tasks.segment"),
        "ecsrc": one_of("flexroad.tasks.filter"),
        "fit": one_of("flexroad.tasks.fit"),
        "sample": TypeAdapter(sample.Options),
        "evaluate": TypeAdapter(evaluate.Options),
        "assess": TypeAdapter(assess.Options),
    }


DEFAULTS: dict[str, dict[str, Any]] = {
    "segment": {"method": "mask"},
    "ecsrc": {"method": "paper"},
    "fit": {"method": "nurbs"},
}
"""Methods of stages that have several, where a file names none."""
