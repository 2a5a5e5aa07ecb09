"""Heights on a grid along a reference line, as OpenCRG has them, and their error."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from pydantic import Field, field_validator

from flexroad.tasks import options as base
from flexroad.tasks.roads.reference_line import ReferenceLine
from flexroad.tasks.types import Floats

HeightAt = Callable[[Floats, Floats], Floats]
"""Heights (m) of the surface at x and y of the reference line's coordinates; NaN where it has none."""


class Options(base.Options):
    """Size of the grid."""

    v_increment_m: float = Field(0.25, ge=0.01, le=5, description="distance across, a multiple of 1 mm (m)")
    margin_m: float = Field(1.0, ge=0, le=50, description="width beside the carriageway, on either side (m)")

    @field_validator("v_increment_m")
    @classmethod
    def _whole_mm(cls, v_increment_m: float) -> float:
        if not math.isclose(v_increment_m * 1000, round(v_increment_m * 1000), rel_tol=1e-9):
            raise ValueError(f"v_increment_m {v_increment_m:g} is not a multiple of 0.001")
        return v_increment_m


@dataclass(frozen=True, eq=False)
class HeightGrid:
    """Heights beside the points of a reference line."""

    line: ReferenceLine
    v: Floats
    """Distances from the line, ``(m,)``, m; ascending by equal steps, positive to the left."""
    heights: Floats
    """``(n, m)``, m; NaN beyond the surface."""


@dataclass(frozen=True)
class GridError:
    """How far bilinear interpolation in a grid misses the surface in the middle of its cells (m)."""

    median_m: float
    max_m: float


def height_grid(line: ReferenceLine, height: HeightAt, options: Options) -> HeightGrid:
    """Return the heights of a surface beside a line, to ``margin_m`` beside its widest place.

    In narrow bends the margin is smaller, so that the grid does not fold.

    Parameters
    ----------
    line : ReferenceLine
        A part of a line that `reference_line.usable` returns.
    height : callable
        The surface in the line's coordinates.
    options : Options
    """
    step = options.v_increment_m
    right, left = line.reach(float(line.width.max()) / 2 + options.margin_m)
    v = np.arange(-round(right // step), round(left // step) + 1, dtype=np.float64) * step
    return HeightGrid(line, v, height(*line.beside(v)))


def grid_error(grid: HeightGrid, height: HeightAt) -> GridError:
    """Return the error of a grid against the surface that it was made from."""
    x, y = grid.line.beside((grid.v[:-1] + grid.v[1:]) / 2)
    z = grid.heights
    middle = (z[:-1, :-1] + z[1:, :-1] + z[:-1, 1:] + z[1:, 1:]) / 4
    missed = np.abs(middle - height((x[:-1] + x[1:]) / 2, (y[:-1] + y[1:]) / 2))
    missed = missed[np.isfinite(missed)]
    if not len(missed):
        return GridError(np.nan, np.nan)
    return GridError(float(np.median(missed)), float(missed.max()))
