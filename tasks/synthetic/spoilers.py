"""What a survey sees instead of the ground: a surface model with objects on it and a mask with errors."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from catalog.grid import Grid
from tasks.synthetic.network import Plan
from tasks.synthetic.noise import Waves
from tasks.synthetic.objects import Car, Crown, House, Objects
from tasks.types import Bools, Floats


class Kind(IntEnum):
    """What the surface model shows in a cell."""

    GROUND = 0
    DECK = 1
    BUILDING = 2
    PARKED_CAR = 3
    MOVING_CAR = 4
    CROWN = 5


GAPS_IN_CROWNS = 0.06
"""Part of a crown's cells through which the scan reaches what is below."""


@dataclass(frozen=True, eq=False)
class Canvas:
    """The cells of a tile with their centres in the plan's frame."""

    grid: Grid
    plan: Plan
    x: Floats
    y: Floats

    @classmethod
    def of(cls, grid: Grid, plan: Plan) -> Canvas:
        """Lay a tile's cells on the plan."""
        easting, northing = np.meshgrid(grid.eastings, grid.northings)
        return cls(grid, plan, *plan.from_map(easting, northing))

    def around(self, x: float, y: float, reach_m: float) -> tuple[slice, slice]:
        """Return the (row, col) window of the cells within reach of a point; empty beyond the tile."""
        grid = self.grid
        easting, northing = self.plan.to_map(x, y)
        n = int(np.ceil(reach_m / grid.cell)) + 1
        col = int((easting - grid.west) // grid.cell)
        row = int((grid.north - northing) // grid.cell)
        return slice(max(row - n, 0), max(row + n + 1, 0)), slice(max(col - n, 0), max(col + n + 1, 0))

    def local(self, window: tuple[slice, slice], x: float, y: float, heading: float) -> tuple[Floats, Floats]:
        """Return the cells' coordinates along and across an object."""
        dx, dy = self.x[window] - x, self.y[window] - y
        cos, sin = np.cos(heading), np.sin(heading)
        return cos * dx + sin * dy, cos * dy - sin * dx


def surface_model(
    canvas: Canvas,
    truth: Floats,
    deck: Bools,
    objects: Objects,
    rng: np.random.Generator,
) -> tuple[Floats, NDArray[np.uint8]]:
    """Return what a scan sees from above (m, without noise) and the `Kind` of each cell."""
    dsm, kind = truth.copy(), np.where(deck, Kind.DECK, Kind.GROUND).astype(np.uint8)
    for house in objects.houses:
        window, z = _roof(canvas, house)
        _raise(dsm[window], kind[window], z, Kind.BUILDING)
    for car in objects.cars:
        window, z = _bodywork(canvas, car)
        what = Kind.MOVING_CAR if car.moving else Kind.PARKED_CAR
        _raise(dsm[window], kind[window], truth[window] + z, what)
    seen = rng.random(truth.shape) >= GAPS_IN_CROWNS
    ragged = rng.normal(0, 0.3, truth.shape)
    for crown in objects.crowns:
        window, z = _foliage(canvas, crown)
        z = np.where(seen[window], z + ragged[window], -np.inf)
        _raise(dsm[window], kind[window], z, Kind.CROWN)
    return dsm, kind


def _raise(dsm: Floats, kind: NDArray[np.uint8], z: Floats, what: Kind) -> None:
    """Lift a window of the model, in place, to ``z`` where that is higher."""
    higher = z > dsm
    dsm[higher] = z[higher]
    kind[higher] = what


def _roof(canvas: Canvas, house: House) -> tuple[tuple[slice, slice], Floats]:
    window = canvas.around(house.x, house.y, float(np.hypot(house.half_length, house.half_depth)))
    u, v = canvas.local(window, house.x, house.y, house.heading)
    # The highest point of a cell counts: roofs reach into cells they cover in part.
    grown = canvas.grid.cell / 4
    inside = (np.abs(u) <= house.half_length + grown) & (np.abs(v) <= house.half_depth + grown)
    ridge = np.clip(1 - np.abs(v) / house.half_depth, 0, 1)
    return window, np.where(inside, house.eaves + house.rise * ridge, -np.inf)


def _bodywork(canvas: Canvas, car: Car) -> tuple[tuple[slice, slice], Floats]:
    window = canvas.around(car.x, car.y, float(np.hypot(car.half_length, car.half_width)))
    u, v = canvas.local(window, car.x, car.y, car.heading)
    inside = (np.abs(u) <= car.half_length) & (np.abs(v) <= car.half_width)
    cabin = np.abs(u) <= 0.6 * car.half_length
    return window, np.where(inside, np.where(cabin, car.height, 0.6 * car.height), -np.inf)


def _foliage(canvas: Canvas, crown: Crown) -> tuple[tuple[slice, slice], Floats]:
    window = canvas.around(crown.x, crown.y, crown.radius)
    out = np.hypot(canvas.x[window] - crown.x, canvas.y[window] - crown.y) / crown.radius
    # Round on top and down to low branches at the rim: a staircase to the road, as scans show it.
    fall = 0.85 * crown.height * (1 - np.sqrt(np.clip(1 - out**2, 0, 1)))
    return window, np.where(out <= 1, crown.top - fall, -np.inf)


def segmentation(canvas: Canvas, edge: Floats, objects: Objects, wobble: Waves, scale: float) -> Bools:
    """Return the road mask a segmentation would give.

    Parameters
    ----------
    canvas : Canvas
        The cells.
    edge : (H, W) array
        Distance to the nearest carriageway's edge, negative on the road (m).
    objects : Objects
        Of these, crowns hide the road, and spots are taken for what they are not.
    wobble : Waves
        By how much the mask's edge is off (m).
    scale : float
        0 for a perfect mask, 1 for errors of the usual size.
    """
    error = scale * wobble(canvas.x, canvas.y)
    mask: Bools = edge + error <= 0
    discs = [(c.x, c.y, 0.8 * c.radius * scale, False) for c in objects.crowns if c.hides]
    discs += [(s.x, s.y, s.radius * scale, s.road) for s in objects.spots]
    for x, y, radius, road in discs:
        window = canvas.around(x, y, radius + 2)
        away = np.hypot(canvas.x[window] - x, canvas.y[window] - y)
        mask[window][away + error[window] < radius] = road
    return mask
