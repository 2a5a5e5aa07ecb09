"""Compose the stages' option models into one configuration; the only reader of configs.

A configuration holds one set of options per stage, and variants: named overrides of these options. All
variants run the same chain of stages. A stage given as a single word is its method: ``fit: plane`` is
``fit: {method: plane}``.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import Annotated, Any, Literal, Union, get_origin

from pydantic import BaseModel, ByteSize, Field, TypeAdapter, model_validator

from flexroad.pipeline.config.stages import HOMES, methods
from flexroad.tasks.options import Options

TAG = {"segment": "method", "ecsrc": "method", "fit": "method", "sample": "method", "cluster": "kind"}
"""Stage or section -> the option that a single word sets."""

ROOT = "defaults"
"""The value of ``extends`` in a configuration that starts from the defaults of the options."""

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


DEFAULT_TIMEOUT_S = 3600
"""Time limit of a tile if the configuration gives none."""
DEFAULT_MEMORY_BYTES = 4 * 1024**3
"""Memory of one SLURM worker if the configuration gives none."""


class Cluster(Options):
    """The workers that process the tiles; `--workers` and `--executor` override it for one command."""

    kind: Literal["local", "slurm"] = Field(
        "local",
        description="local: processes of this machine; slurm: jobs of SLURM (pip install 'flexroad[slurm]')",
    )
    workers: int | None = Field(
        None,
        ge=1,
        le=100_000,
        description="largest number of worker processes; local: by default one per core",
    )
    memory: ByteSize | None = Field(
        None,
        ge=100 * 1024**2,
        description="memory of each worker, such as 4 GiB; a tile that needs more is stopped and fails. By "
        "default an equal share of this machine's memory, with slurm 4 GiB. With a value, all tiles run on "
        "workers",
    )
    tile_timeout_s: float = Field(
        DEFAULT_TIMEOUT_S,
        ge=1,
        le=604_800,
        description="longest time for one tile (s). A worker that takes longer is stopped, and the tile is "
        "tried once more alone before it fails. With a value other than the default, tiles run on workers",
    )
    security: Literal["tls", "none"] = Field(
        "tls",
        description="tls: scheduler and workers answer only processes with certificates made for this "
        "command. none: whoever reaches their ports can run programs as you. A running scheduler uses "
        "Dask's own configuration",
    )
    flush: bool = Field(
        True,
        description="write each tile's products and marker to the disk (fsync) before the tile is done. "
        "false saves some milliseconds per tile, but a power failure may leave damaged products",
    )
    start_s: float = Field(
        3600,
        gt=0,
        le=604_800,
        description="slurm: waiting time for the first worker, and for a new worker when all are lost (s)",
    )
    walltime_h: float = Field(8, gt=0, le=10_000, description="slurm: time limit of each job (hours)")
    queue: str | None = Field(None, min_length=1, description="slurm: partition (-p)")
    per_job: int = Field(1, ge=1, le=1024, description="slurm: workers per job, one core each")
    interface: str | None = Field(
        None, min_length=1, description="slurm: network interface between workers and this machine, like ib0"
    )
    job_extra: tuple[str, ...] = Field((), description="slurm: further #SBATCH lines, like --account=NAME")
    prologue: tuple[str, ...] = Field(
        (), description="slurm: shell lines run before a worker starts, like module load gdal"
    )

    @property
    def needs_workers(self) -> bool:
        """Whether tiles must run on workers: on other machines, or within limits of memory and time."""
        limited = self.memory is not None or self.tile_timeout_s != DEFAULT_TIMEOUT_S
        return limited or self.kind != "local"

    @property
    def programs(self) -> dict[str, Any]:
        """The given options that can start programs, or let other users start programs.

        These are ``security: none``, and options of free text, which are written into a job's script.
        """
        fields = type(self).model_fields.items()
        texts = {name for name, field in fields if get_origin(field.annotation) is not Literal} | {"security"}
        given = self.model_dump(mode="json", include=texts, exclude_defaults=True).items()
        return {name: value for name, value in given if not isinstance(value, int | float)}


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
