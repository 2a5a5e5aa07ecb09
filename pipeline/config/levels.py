"""What roads on several levels need of the other stages of a configuration."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from flexroad.pipeline.errors import ConfigError

HALO_M = 40.0
"""Smallest halo (m): farther away nothing decides on the levels at the border of a tile."""


def check_levels(chain: Mapping[str, Any], where: str) -> None:
    """Check that the stages of a variant can compute levels, if its segmentation has them."""
    if not getattr(chain["segment"], "levels", False):
        return
    load, sample = chain["load"], chain["sample"]
    needs = [
        (chain["ecsrc"].method == "planar", f"ecsrc: planar, not {chain['ecsrc'].method}"),
        (chain["fit"].method == "smoothing_spline", f"fit: smoothing_spline, not {chain['fit'].method}"),
        (load.halo_m >= HALO_M, f"load.halo_m of {HALO_M:g} or more, not {load.halo_m:g}"),
        (
            sample.method == "dynamic",
            f"sample.method dynamic, not {sample.method}",
        ),
        (sample.mask == "raw", f"sample.mask raw, not {sample.mask}"),
    ]
    for fine, needed in needs:
        if not fine:
            raise ConfigError(
                f"{where}: segment.levels needs {needed}; set it, or set segment.levels to false"
            )
