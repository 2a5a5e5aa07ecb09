"""The workers of a run: the `cluster:` section of a configuration.

It does not affect results: it is not part of any fingerprint, and a file that extends another may change it.
"""

from __future__ import annotations

from typing import Any, Literal, get_origin

from pydantic import ByteSize, Field

from flexroad.tasks.options import Options

DEFAULT_TIMEOUT_S = 3600
"""Time limit of a tile if the configuration gives none."""
DEFAULT_MEMORY_BYTES = 4 * 1024**3
"""Memory of one SLURM worker if the configuration gives none."""


class Cluster(Options):
    """The workers that process the tiles; `--workers` and `--executor` override it for one command."""

    kind: Literal["local", "slurm"] = Field(
        "local",
        description="local: processes of this machine; slurm: workers requested there "
        "(pip install 'flexroad[slurm]')",
    )
    workers: int | None = Field(
        None,
        ge=1,
        le=100_000,
        description="most worker processes, of one thread; local: by default one per core",
    )
    memory: ByteSize | None = Field(
        None,
        ge=100 * 1024**2,
        description="memory of each worker, as 4 GiB; a value starts workers for any tile; by default an "
        "equal share of this machine's memory, on slurm 4 GiB; a tile that needs more is "
        "stopped and becomes a failed row",
    )
    tile_timeout_s: float = Field(
        DEFAULT_TIMEOUT_S,
        ge=1,
        le=604_800,
        description="longest time for one tile (s): a worker that takes longer is stopped, the tile is tried "
        "once more alone, and is then a failed row; only on workers: another value starts them for any tile",
    )
    security: Literal["tls", "none"] = Field(
        "tls",
        description="tls: scheduler and workers answer only processes with certificates made for this "
        "command; none: whoever reaches their ports can run programs as you; for a running "
        "scheduler Dask's own configuration counts",
    )
    flush: bool = Field(
        True,
        description="write each tile's products and marker to the disk (fsync) before it counts as done; "
        "false saves some milliseconds per tile, but a power failure may leave damaged products",
    )
    start_s: float = Field(
        3600,
        gt=0,
        le=604_800,
        description="slurm: waiting time for the first worker, and for a new one when all are lost (s)",
    )
    walltime_h: float = Field(8, gt=0, le=10_000, description="slurm: time limit of each job (hours)")
    queue: str | None = Field(None, min_length=1, description="slurm: partition (-p)")
    per_job: int = Field(1, ge=1, le=1024, description="slurm: workers per job, one core each")
    interface: str | None = Field(
        None, min_length=1, description="slurm: network interface between workers and this machine, as ib0"
    )
    job_extra: tuple[str, ...] = Field((), description="slurm: further #SBATCH lines, as --account=NAME")
    prologue: tuple[str, ...] = Field(
        (), description="slurm: shell lines run before a worker starts, as module load gdal"
    )

    @property
    def needs_workers(self) -> bool:
        """Whether tiles run on workers only: on other machines, or within limits of memory and time."""
        limited = self.memory is not None or self.tile_timeout_s != DEFAULT_TIMEOUT_S
        return limited or self.kind != "local"

    @property
    def programs(self) -> dict[str, Any]:
        """The given options that can start programs, or let others do so.

        These are those of free text, in a job's script, and ``security: none``.
        """
        fields = type(self).model_fields.items()
        texts = {name for name, field in fields if get_origin(field.annotation) is not Literal} | {"security"}
        given = self.model_dump(mode="json", include=texts, exclude_defaults=True).items()
        return {name: value for name, value in given if not isinstance(value, int | float)}
