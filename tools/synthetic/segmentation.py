"""The road mask that a segmentation of the orthophoto gives, with its errors."""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np
from scipy.special import ndtri

from flexroad.catalog.grid import Grid
from flexroad.tasks.types import Bools, Floats
from flexroad.tools.synthetic.noise import field
from flexroad.tools.synthetic.objects import GroundAt, Roof
from flexroad.tools.synthetic.options import SceneOptions
from flexroad.tools.synthetic.population import Area, Objects
from flexroad.tools.synthetic.spoilers import Canvas, covered

WOBBLE_M = (5.0, 40.0)
"""Shortest and longest wave of the offset of the mask's edges (m)."""
STRETCH_M = (20.0, 120.0)
"""Shortest and longest wave of the fields that say where the mask reaches beyond the carriageway (m)."""
SOLID = 0.8
"""Radius of the part of a crown that hides what is below, as a fraction of the crown's radius."""
FACADE_REACH_M = 8.0
"""Greatest distance from the carriageway of a facade that is mistaken for road (m)."""


def segmentation(
    canvas: Canvas, edge: Floats, objects: Objects, ground_at: GroundAt, options: SceneOptions
) -> Bools:
    """Return the road mask with the errors of a segmentation, ``(H, W)``.

    - `edge`: distance of the cells to the nearest carriageway's edge, negative on the road (m).
    - `objects`: objects: crowns hide the road; spots, and some areas, roofs and facades, are classified
      wrongly.
    - `ground_at`: returns the ground at points, for patches.
    - `options`: sizes of the errors; ``mask_errors`` 0 gives a perfect mask.
    """
    if not options.patch_m or not options.mask_errors:
        return _classified(canvas, edge, objects, options)
    patches = Canvas.of(_patches(canvas.grid, options.patch_m), canvas.plan)
    mask = _classified(patches, ground_at(patches.x, patches.y).edge, objects, options)
    # The mask is resampled to the cells by nearest neighbour, as in the paper.
    return mask[patches.grid.cells(*np.meshgrid(canvas.grid.eastings, canvas.grid.northings))]


def _patches(grid: Grid, side: float) -> Grid:
    """Return the lattice of patches that covers a grid; it is the same for all grids."""
    west, south, east, north = grid.bounds
    west, south = (math.floor(bound / side) * side for bound in (west, south))
    east, north = (math.ceil(bound / side) * side for bound in (east, north))
    return Grid(grid.crs, west, north, side, round((east - west) / side), round((north - south) / side))


def _classified(canvas: Canvas, edge: Floats, objects: Objects, options: SceneOptions) -> Bools:
    """Return the mask at the points of a canvas, ``(H, W)``."""
    scale = options.mask_errors
    error = scale * field(canvas.plan.seed, "wobble", WOBBLE_M, 12, options.wobble_m)(canvas.x, canvas.y)
    verge = np.where(_stretches(canvas, "verge", options.verge_share), options.verge_m, 0.0)
    mask: Bools = edge + error <= scale * verge
    if scale > 0:
        mask |= _stretches(canvas, "open ground", options.open_ground)
        _add(mask, canvas, objects.yards, error)
    for crown in objects.crowns:
        if crown.hides:
            window, inside = _disc(canvas, crown.x, crown.y, SOLID * crown.radius * scale, error)
            mask[window][inside] = False
        if objects.roofs:
            # Under most crowns the road is inferred, but beyond the carriageway every crown is seen.
            window, inside = _disc(canvas, crown.x, crown.y, crown.radius * scale, error)
            mask[window][inside & (edge[window] > 0)] = False
    for spot in objects.spots:
        window, inside = _disc(canvas, spot.x, spot.y, spot.radius * scale, error)
        mask[window][inside] = spot.road
    if scale > 0:
        _add(mask, canvas, (*objects.car_parks, *objects.fields), error)
        for roof in objects.roofs:
            _show(roof, mask, canvas, edge, options.overhang_m)
        _add(mask, canvas, objects.false_roofs, error)
    return mask


def _disc(
    canvas: Canvas, x: float, y: float, radius: float, error: Floats
) -> tuple[tuple[slice, slice], Bools]:
    """Return the window and the cells of a disc whose edge is shifted by ``error`` (m)."""
    window = canvas.around(x, y, radius + 2)
    away = np.hypot(canvas.x[window] - x, canvas.y[window] - y)
    return window, away + error[window] < radius


def _stretches(canvas: Canvas, purpose: str, share: float) -> Bools:
    """Return coherent areas that cover a fraction of the plane, ``(H, W)``."""
    if share <= 0:
        return np.zeros(canvas.x.shape, np.bool_)
    inside: Bools = field(canvas.plan.seed, purpose, STRETCH_M, 15)(canvas.x, canvas.y) < ndtri(share)
    return inside


def _add(mask: Bools, canvas: Canvas, areas: Iterable[Area], error: Floats) -> None:
    """Add the areas that are mistaken for road, in place."""
    for area in areas:
        if area.as_road:
            window, inside = covered(canvas, area, error)
            mask[window][inside] = True


def _show(roof: Roof, mask: Bools, canvas: Canvas, edge: Floats, overhang_m: float) -> None:
    """Remove what a roof hides in the photograph, and add its visible facades, in place."""
    house, (east, north) = roof.house, roof.shift
    reach = math.hypot(house.half_length, house.half_depth) + overhang_m + math.hypot(east, north)
    window = canvas.around(house.x, house.y, reach)
    size = house.half_length + overhang_m, house.half_depth + overhang_m
    stands, seen = (
        (np.abs(u) <= size[0]) & (np.abs(v) <= size[1])
        for u, v in (
            canvas.local(window, house.x + dx, house.y + dy, house.heading)
            for dx, dy in ((0.0, 0.0), (east, north))
        )
    )
    mask[window][seen | stands] = False
    if roof.facade_as_road:
        mask[window][stands & ~seen & (edge[window] <= FACADE_REACH_M)] = True
