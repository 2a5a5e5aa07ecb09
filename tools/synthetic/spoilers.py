"""The surface model of a survey, with objects that hide the ground ("spoilers")."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from flexroad.catalog.grid import Grid
from flexroad.tasks.types import Bools, Floats
from flexroad.tools.synthetic.network import Plan
from flexroad.tools.synthetic.objects import Car, Crown, House
from flexroad.tools.synthetic.population import Area, Objects


class Kind(IntEnum):
    """Kind of the object in a cell of the surface model."""

    GROUND = 0
    DECK = 1
    BUILDING = 2
    PARKED_CAR = 3
    MOVING_CAR = 4
    CROWN = 5
    PLANTS = 6
    RAIL = 7
    WIRE = 8
    MIXED = 9
    """Cell at a wall, with a height between ground and top."""
    PAVED = 10
    """Ground of a car park or a yard."""
    FIELD = 11
    """Bare ground that looks like road from above."""


BARE = (Kind.GROUND, Kind.DECK, Kind.PAVED, Kind.FIELD)
"""Kinds without an object: the surface model has the height of the true ground."""
GAPS_IN_CROWNS = 0.06
"""Fraction of a crown's cells in which the scan shows the surface below."""
RAIL_ECHOES, WIRE_ECHOES = 0.3, 0.06
"""Fraction of the points along a rail and a wire that set the height of their cell."""


@dataclass(frozen=True, eq=False)
class Canvas:
    """The cells of a tile, with their centres in the plan's frame, ``(H, W)`` (m)."""

    grid: Grid
    plan: Plan
    x: Floats
    y: Floats

    @classmethod
    def of(cls, grid: Grid, plan: Plan) -> Canvas:
        """Return the canvas of a grid on a plan."""
        easting, northing = np.meshgrid(grid.eastings, grid.northings)
        return cls(grid, plan, *plan.from_map(easting, northing))

    def around(self, x: float, y: float, reach_m: float) -> tuple[slice, slice]:
        """Return the (row, col) window of the cells within a distance of a point; empty beyond the tile."""
        grid = self.grid
        easting, northing = self.plan.to_map(x, y)
        n = int(np.ceil(reach_m / grid.cell)) + 1
        col = int((easting - grid.west) // grid.cell)
        row = int((grid.north - northing) // grid.cell)
        return slice(max(row - n, 0), max(row + n + 1, 0)), slice(max(col - n, 0), max(col + n + 1, 0))

    def local(self, window: tuple[slice, slice], x: float, y: float, heading: float) -> tuple[Floats, Floats]:
        """Return the coordinates of a window's cells along and across an object (m)."""
        dx, dy = self.x[window] - x, self.y[window] - y
        cos, sin = np.cos(heading), np.sin(heading)
        return cos * dx + sin * dy, cos * dy - sin * dx


def surface_model(
    canvas: Canvas,
    truth: Floats,
    deck: Bools,
    objects: Objects,
    overhang_m: float,
    rng: np.random.Generator,
) -> tuple[Floats, NDArray[np.uint8]]:
    """Return the surface model of a scan (m, without noise) and the `Kind` of each cell, ``(H, W)``.

    Low vegetation and mixed cells are added later. Roofs reach ``overhang_m`` beyond the walls.
    """
    dsm, kind = truth.copy(), np.where(deck, Kind.DECK, Kind.GROUND).astype(np.uint8)
    for areas, area_kind in (
        ((*objects.car_parks, *objects.yards), Kind.PAVED),
        (objects.fields, Kind.FIELD),
    ):
        for area in areas:
            window, inside = covered(canvas, area, np.zeros(truth.shape))
            kind[window][inside] = area_kind
    for house in objects.houses:
        window, z = _roof(canvas, house, overhang_m)
        _raise(dsm[window], kind[window], z, Kind.BUILDING)
    for car in objects.cars:
        window, z = _bodywork(canvas, car)
        car_kind = Kind.MOVING_CAR if car.moving else Kind.PARKED_CAR
        _raise(dsm[window], kind[window], truth[window] + z, car_kind)
    leafy = rng.random(truth.shape) >= GAPS_IN_CROWNS
    ragged = rng.normal(0, 0.3, truth.shape)
    for crown in objects.crowns:
        window, z = _foliage(canvas, crown)
        z = np.where(leafy[window], z + ragged[window], -np.inf)
        _raise(dsm[window], kind[window], z, Kind.CROWN)
    _trace(canvas, dsm, kind, objects.rails, Kind.RAIL, rng)
    _trace(canvas, dsm, kind, objects.wires, Kind.WIRE, rng)
    return dsm, kind


def _trace(
    canvas: Canvas,
    dsm: Floats,
    kind: NDArray[np.uint8],
    points: Floats,
    new_kind: Kind,
    rng: np.random.Generator,
) -> None:
    """Raise cells along a thin line, in place; only a fraction of the pulses hits the line."""
    share = RAIL_ECHOES if new_kind == Kind.RAIL else WIRE_ECHOES
    west, south, east, north = canvas.grid.bounds
    easting, northing = canvas.plan.to_map(*points[:2])
    inside = (easting > west) & (easting < east) & (northing > south) & (northing < north)
    hit = inside & (rng.random(inside.size) < share)
    row, col = canvas.grid.cells(easting[hit], northing[hit])
    z = points[2, hit]
    higher = z > dsm[row, col]
    row, col, z = row[higher], col[higher], z[higher]
    np.maximum.at(dsm, (row, col), z)
    kind[row, col] = new_kind


def _raise(dsm: Floats, kind: NDArray[np.uint8], z: Floats, new_kind: Kind) -> None:
    """Raise a window of the model to ``z``, in place, where ``z`` is higher."""
    higher = z > dsm
    dsm[higher] = z[higher]
    kind[higher] = new_kind


def _roof(canvas: Canvas, house: House, overhang_m: float) -> tuple[tuple[slice, slice], Floats]:
    reach = float(np.hypot(house.half_length, house.half_depth)) + 2 * overhang_m
    window = canvas.around(house.x, house.y, reach)
    u, v = canvas.local(window, house.x, house.y, house.heading)
    # A cell has the height of its highest point, so a roof includes partly covered cells.
    grown = canvas.grid.cell / 4 + overhang_m
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
    # Round on top, with low branches at the rim: so there are steps down to the road, as in real scans.
    fall = 0.85 * crown.height * (1 - np.sqrt(np.clip(1 - out**2, 0, 1)))
    return window, np.where(out <= 1, crown.top - fall, -np.inf)


def covered(canvas: Canvas, area: Area, error: Floats) -> tuple[tuple[slice, slice], Bools]:
    """Return the window and the cells of an area whose edge is shifted by ``error`` (m)."""
    window = canvas.around(area.x, area.y, float(np.hypot(area.half_length, area.half_width)) + 2)
    u, v = canvas.local(window, area.x, area.y, area.heading)
    beyond = np.maximum(np.abs(u) - area.half_length, np.abs(v) - area.half_width)
    return window, beyond + error[window] <= 0
