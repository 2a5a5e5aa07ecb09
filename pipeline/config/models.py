"""Compose the stages' option models into one configuration; the only reader of configs.

A configuration holds one set of options per stage, and variants: named overrides of these options. All
variants run the same chain of stages. A stage given as a single word is its method: ``fit: plane`` is
``fit: {method: plane}``.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import Annotated, Any, Literal, Union

from pydantic import BaseModel, Field, TypeAdapter, model_validator

from flexroad.pipeline.config.cluster import Cluster
from flexroad.pipeline.config.stages import HOMES, methods
from flexroad.tasks.options import Options

TAG = {"segment": "method", "ecsrc": "method", "fit": "method", "sample": "method", "cluster": "kind"}
"""Stage or section -> the option that a single word sets."""

ROOT = "defaults"
"""What a configuration extends whose options start from their own defaults, not from another's values."""

Chain = Mapping[str, Options]
"""The options of one variant, by stage, in the paper's order."""


Format = Literal["glb", "ply", "cog", "npz"]


class Export(Options):
    """The products written for the user, besides the metrics."""

    variants: tuple[str, ...] = Field(
        ("flexroad",), min_length=1, description="variants whose meshes are kept; query uses the first"
    )
    formats: tuple[Format, ...] = Field(
        ("glb", "ply", "cog", "npz"),
        description="glb and ply: the mesh; cog: height and road mask; npz: the NURBS surface itself",
    )
    texture: bool = Field(
        False, description="whether the GLB has the tile's orthophoto (layer dop) as its colours"
    )
    texture_px: int = Field(
        4096,
        ge=64,
        le=16384,
        description="largest width and height of the texture (pixels); a finer photo is averaged",
    )

    @model_validator(mode="after")
    def _texture_has_a_mesh(self) -> Export:
        if self.texture and "glb" not in self.formats:
            raise ValueError(
                f"texture needs the format glb, not only {', '.join(self.formats)}; add it to formats"
            )
        return self


class Config(BaseModel):
    """The configuration of a run: the chain of every variant, the export and the cluster."""

    model_config = {"frozen": True, "arbitrary_types_allowed": True}

    name: str
    chains: dict[str, dict[str, Any]]
    """Variant -> stage -> options (`Options`); variants in the file's order, stages in the paper's."""
    export: Export
    cluster: Cluster
    dataset: dict[str, Any]
    """Locations of a published dataset's files; validated and used by `catalog.sources`."""
    raw: dict[str, Any]
    """The file with ``extends`` resolved, so that it extends `ROOT`, as written to the run's config.yaml."""


@cache
def stage_models() -> dict[str, TypeAdapter[Options]]:
    """Return the validator of each stage's options, in the paper's order."""
    adapters: dict[str, TypeAdapter[Options]] = {}
    for stage in HOMES:
        models: Any = tuple(dict.fromkeys(module.Options for module in methods(stage).values()))
        chosen: Any = models[0]
        if len(models) > 1:
            union: Any = Union[models]  # noqa: UP007 (the models are only known at run time)
            chosen = Annotated[union, Field(discriminator="method")]
        adapters[stage] = TypeAdapter(chosen)
    return adapters
