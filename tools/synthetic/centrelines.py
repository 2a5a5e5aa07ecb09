"""Centre lines of the synthetic streets with class and width, in map coordinates."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from flexroad.catalog.grid import Grid
from flexroad.tasks.types import Floats
from flexroad.tools.synthetic.network import Plan, Stream, Street
from flexroad.tools.synthetic.scene import plan_of
from flexroad.tools.synthetic.surfaces import CIRCLE_M, ISLAND_M, SUNKEN_M
from flexroad.tools.synthetic.world import DEFAULTS, SceneOptions

STEP_M = 5.0
"""Distance between the points of a line (m)."""
MARGIN_M = 50.0
"""Lines within this distance around the grid are included (m)."""
MAIN, SIDE, SUNKEN = "secondary", "residential", "primary"


@dataclass(frozen=True, eq=False)
class CentreLine:
    """The centre line of one carriageway."""

    points: Floats
    """``(n, 2)``: easting and northing (m)."""
    width_m: float
    highway: str
    """Class: a value of OSM's ``highway`` key."""
    level: int = 0
    """Number of the level: above 0 on a deck, below 0 in a tunnel."""


def centre_lines(
    grid: Grid, seed: int, stratum: str | None = None, options: SceneOptions = DEFAULTS
) -> list[CentreLine]:
    """Return the centre lines on and around a grid, in the world of `make_scene` with the same arguments.

    A dual carriageway has two lines. The ends of medians are not represented, nor are the islands of
    roundabouts where streets join.
    """
    plan = plan_of(seed, stratum, options)
    west, south, east, north = grid.buffered(MARGIN_M).bounds
    x, y = plan.from_map(np.array([west, west, east, east]), np.array([south, north, south, north]))
    box = (float(x.min()), float(y.min()), float(x.max()), float(y.max()))
    lines = [line for street in plan.streets(box) for line in _carriageways(plan, street)]
    lines += [_sunken(plan, stream, box[1], box[3]) for stream in plan.streams(box) if stream.paved]
    return lines + [_circle(plan, *centre) for centre in plan.circles(box, 0)]


def _carriageways(plan: Plan, street: Street) -> Iterator[CentreLine]:
    along = _steps(street.start, street.end)
    beside, width = (street.half_width_m + street.median_m) / 2, street.half_width_m - street.median_m
    highway = SIDE if street.key[1] % 2 else MAIN
    if not street.median_m:
        yield CentreLine(_on_map(plan, *street.point(along, 0.0)), 2 * width, highway)
        return
    for side in (-beside, beside):
        yield CentreLine(_on_map(plan, *street.point(along, side)), width, highway)


def _sunken(plan: Plan, stream: Stream, low: float, high: float) -> CentreLine:
    left, right = stream.banks
    y = _steps(low, high)
    return CentreLine(_on_map(plan, (left.across(y) + right.across(y)) / 2, y), 2 * SUNKEN_M, SUNKEN)


def _circle(plan: Plan, x: float, y: float) -> CentreLine:
    turn, radius = np.linspace(0, 2 * np.pi, 33), (CIRCLE_M + ISLAND_M) / 2
    turn[-1] = 0
    ring = _on_map(plan, x + radius * np.cos(turn), y + radius * np.sin(turn))
    return CentreLine(ring, CIRCLE_M - ISLAND_M, MAIN)


def _steps(start: float, end: float) -> Floats:
    return np.linspace(start, end, max(2, round((end - start) / STEP_M) + 1))


def _on_map(plan: Plan, x: Floats, y: Floats) -> Floats:
    return np.column_stack(plan.to_map(x, y))
