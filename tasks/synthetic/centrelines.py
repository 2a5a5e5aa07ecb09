"""The made streets as a map has them: centre lines with a class and a width, in map coordinates."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from flexroad.catalog.grid import Grid
from flexroad.tasks.synthetic.network import Plan, Stream, Street
from flexroad.tasks.synthetic.options import DEFAULTS, SceneOptions
from flexroad.tasks.synthetic.scene import plan_of
from flexroad.tasks.synthetic.surfaces import CIRCLE_M, ISLAND_M, SUNKEN_M
from flexroad.tasks.types import Floats

STEP_M = 5.0
"""Between the points of a line."""
MARGIN_M = 50.0
"""Lines are given as far as this around the ground asked for."""
MAIN, SIDE, SUNKEN = "secondary", "residential", "primary"


@dataclass(frozen=True, eq=False)
class CentreLine:
    """One carriageway."""

    points: Floats
    """``(n, 2)``: easting and northing (m)."""
    width_m: float
    highway: str
    """Class, in OSM's words."""


def centre_lines(
    grid: Grid, seed: int, stratum: str | None = None, options: SceneOptions = DEFAULTS
) -> list[CentreLine]:
    """Return the centre lines on and around a grid, of the world `make_scene` makes of the same arguments.

    A dual carriageway has two. Not told are medians' noses and roundabouts' islands where streets run in.
    """
    plan = plan_of(seed, stratum, options)
    west, south, east, north = grid.buffered(MARGIN_M).bounds
    x, y = plan.from_map(np.array([west, west, east, east]), np.array([south, north, south, north]))
    box = (float(x.min()), float(y.min()), float(x.max()), float(y.max()))
    found = [line for street in plan.streets(box) for line in _carriageways(plan, street)]
    found += [_sunken(plan, stream, box[1], box[3]) for stream in plan.streams(box) if stream.paved]
    return found + [_circle(plan, *centre) for centre in plan.circles(box, 0)]


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
    one, other = stream.banks
    y = _steps(low, high)
    return CentreLine(_on_map(plan, (one.across(y) + other.across(y)) / 2, y), 2 * SUNKEN_M, SUNKEN)


def _circle(plan: Plan, x: float, y: float) -> CentreLine:
    turn, radius = np.linspace(0, 2 * np.pi, 33), (CIRCLE_M + ISLAND_M) / 2
    turn[-1] = 0
    ring = _on_map(plan, x + radius * np.cos(turn), y + radius * np.sin(turn))
    return CentreLine(ring, CIRCLE_M - ISLAND_M, MAIN)


def _steps(start: float, end: float) -> Floats:
    return np.linspace(start, end, max(2, round((end - start) / STEP_M) + 1))


def _on_map(plan: Plan, x: Floats, y: Floats) -> Floats:
    return np.column_stack(plan.to_map(x, y))
