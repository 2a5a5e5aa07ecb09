"""Where a run's workers come from: the `cluster:` section of a configuration.

It says who works, never what is made: no fingerprint knows it, and a file that extends another may change it.
"""

from __future__ import annotations

from typing import Literal

from pydantic import ByteSize, Field

from flexroad.tasks.options import Options


class Cluster(Options):
    """Who does the tiles; `--workers` and `--scheduler` override it for one command."""

    kind: Literal["local", "slurm", "kubernetes"] = Field(
        "local",
        description="local: processes of this machine; slurm, kubernetes: workers asked for there "
        "(pip install 'flexroad[slurm]' or 'flexroad[kubernetes]')",
    )
    workers: int | None = Field(
        None, ge=1, le=100_000, description="worker processes of one thread; local: by default one per core"
    )
    memory: ByteSize | None = Field(
        None,
        ge=100 * 1024**2,
        description="of each worker, as 4 GiB; by default this machine's shared out, elsewhere 4 GiB; "
        "a tile that needs more is stopped and becomes a failed row",
    )
    patience_s: float = Field(
        60, ge=0, le=86_400, description="how long a run waits for a worker when none is left (s)"
    )
    start_s: float = Field(
        3600, gt=0, le=604_800, description="slurm, kubernetes: how long to wait for the first worker (s)"
    )
    walltime_h: float = Field(8, gt=0, le=10_000, description="slurm: of each job (hours)")
    queue: str | None = Field(None, min_length=1, description="slurm: partition (-p)")
    account: str | None = Field(None, min_length=1, description="slurm: account (-A)")
    per_job: int = Field(1, ge=1, le=1024, description="slurm: workers of one job, a core each")
    interface: str | None = Field(
        None, min_length=1, description="slurm: network interface that workers reach this machine by, as ib0"
    )
    job_extra: tuple[str, ...] = Field((), description="slurm: further #SBATCH lines, as --exclusive")
    prologue: tuple[str, ...] = Field(
        (), description="slurm: shell lines before a worker starts, as module load gdal"
    )
    image: str | None = Field(None, min_length=1, description="kubernetes: image of scheduler and workers")
    namespace: str | None = Field(None, min_length=1, description="kubernetes: where they are made")
