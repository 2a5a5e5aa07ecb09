"""Compose the stages' option models into one configuration; the only reader of configs.

A configuration holds one set of options per stage, and variants: named overrides of them. A variant is
never a code path, only other options for the same chain of stages. A stage given as a bare word means its
method: ``fit: plane`` is ``fit: {method: plane}``.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import Annotated, Any, Literal, Union

from pydantic import BaseModel, Field, TypeAdapter

from flexroad.pipeline.config.cluster import Cluster
from flexroad.pipeline.config.methods import HOMES, methods
from flexroad.tasks.options import Options

TAG = {"segment": "method", "ecsrc": "method", "fit": "method", "sample": "method", "cluster": "kind"}
"""The option that a bare word stands for, by stage or section."""


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
def stage_models() -> dict[str, TypeAdapter[Options]]:
    """Return what validates the options of each stage, in the paper's order."""
    found: dict[str, TypeAdapter[Options]] = {}
    for stage in HOMES:
        models: Any = tuple(dict.fromkeys(module.Options for module in methods(stage).values()))
        chosen: Any = models[0]
        if len(models) > 1:
            union: Any = Union[models]  # noqa: UP007 (which models there are is known only now)
            chosen = Annotated[union, Field(discriminator="method")]
        found[stage] = TypeAdapter(chosen)
    return found
