"""Checks of a CRS against coordinates: whether they are degrees, its scale on the ground, another place."""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import lru_cache

import numpy as np
from pyproj import CRS, Geod, Transformer

from flexroad.catalog.crs import bounds_in, in_plan, is_geographic, is_projected, plan_unit, short, utm_of
from flexroad.catalog.errors import CatalogError
from flexroad.catalog.grid import Bounds, overlap
from flexroad.catalog.text import edges

MAX_SCALE_ERROR = 0.01
"""Largest share by which a metre of a CRS may differ from a metre on the ground."""
STEP = 10.0
"""Length over which the scale is measured (units of the CRS)."""
TURN_AND_BIT = 1.005
"""Largest degrees are 360 and 90 times this: files reach half a cell beyond the poles."""
ZONE = 1e6
"""The number of the zone in front of an easting adds a multiple of this (m)."""
ZONED = {"EPSG:25831": "EPSG:5649", "EPSG:25832": "EPSG:4647", "EPSG:25833": "EPSG:5650"}
"""CRS -> the same with the number of the zone before the easting."""


def may_be_in(crs: str, bounds: Bounds) -> bool:
    """Return whether bounds may be in a CRS: angles are at most a full turn and a right angle."""
    if not is_geographic(crs):
        return True
    turn = 2 * math.pi / plan_unit(crs)[1] * TURN_AND_BIT
    west, south, east, north = map(abs, bounds)
    return max(west, east) <= turn and max(south, north) <= turn / 4


def crs_of(declared: str | None, given: str | None, bounds: Bounds) -> str | None:
    """Return the CRS of a file: the declared one, or the given one if the file declares none or a wrong one.

    - `declared`, `given`: the CRS in the file, and the CRS for files without one.
    - `bounds`: the bounds of the file, in its CRS; NaN if they are unknown.
    """
    if declared and (given is None or not np.isfinite(bounds).all() or may_be_in(declared, bounds)):
        return declared
    return given


def angle_fault(crs: str, bounds: Bounds) -> str | None:
    """Return a message if a CRS has angles but the coordinates are not angles, to follow a file's name."""
    if not np.isfinite(bounds).all() or may_be_in(crs, bounds):
        return None
    west, south, east, north = bounds
    turn = 2 * math.pi / plan_unit(crs)[1] * TURN_AND_BIT
    across, along = max(west, east, key=abs), max(south, north, key=abs)
    wrong = f"{across:.10g} is no longitude" if abs(across) > turn else f"{along:.10g} is no latitude"
    return f"has the CRS {short(crs)}, but {wrong}"


def require_scale(title: str, crs: str, bounds: Bounds, remedy: str) -> None:
    """Check that a metre of a CRS is a metre on the ground, within `MAX_SCALE_ERROR`.

    - `crs`: a CRS in metres; one that is not projected is not checked.
    - `bounds`: bounds of the data, in the CRS; the scale is measured at their centre.
    - `remedy`: what to do, for the message; ``{zone}`` is replaced by the code of the UTM zone.
    """
    if not is_projected(crs):
        return
    x, y = (bounds[0] + bounds[2]) / 2, (bounds[1] + bounds[3]) / 2
    to_degrees, geod = _to_degrees(in_plan(crs))
    xs, ys = np.array([x, x - STEP, x + STEP, x, x]), np.array([y, y, y, y - STEP, y + STEP])
    east, north = to_degrees.transform(xs, ys)
    if not (np.isfinite(east).all() and np.isfinite(north).all()):
        zoned = ZONED.get(in_plan(crs))
        hint = f"declare {zoned} if its eastings begin with the number of the zone" if zoned else "correct it"
        raise CatalogError(f"{title}: {x:.10g} {y:.10g} is no place in {short(crs)}; {hint}")
    directions, _, lengths = geod.inv(east[1::2], north[1::2], east[2::2], north[2::2])
    angles = np.radians(directions)
    ground = np.array([np.sin(angles) * lengths, np.cos(angles) * lengths]) / (2 * STEP)
    most, least = np.linalg.svd(ground, compute_uv=False)
    if max(abs(most - 1), abs(least - 1)) <= MAX_SCALE_ERROR:
        return
    metres = f"{least:.3g}" if most - least < 0.01 else f"{least:.3g} to {most:.3g}"
    place = f"longitude {east[0]:.1f}, latitude {north[0]:.1f}"
    zone = utm_of((east[0], north[0], east[0], north[0]))
    raise CatalogError(
        f"{title}: a metre of {short(crs)} is {metres} m on the ground at {place}; {remedy.format(zone=zone)}"
    )


@lru_cache(maxsize=16)
def _to_degrees(crs: str) -> tuple[Transformer, Geod]:
    """Return the transformer of a projected CRS to longitude and latitude, and their ellipsoid."""
    plan = CRS(crs).to_2d()
    return Transformer.from_crs(plan, plan.geodetic_crs, always_xy=True), plan.get_geod() or Geod(
        ellps="WGS84"
    )


def elsewhere(crs: str, bounds: Bounds, target: str, ground: Bounds, reach_m: float) -> str:
    """Return the places of the tiles and of a layer that does not reach them, to follow the layer's name.

    - `crs`, `bounds`: CRS and bounds of the layer; `target`, `ground`: CRS and bounds of the tiles.
    - `reach_m`: distance up to which a layer reaches a tile (m).
    """
    text = f"lies at {edges(bounds)} in {short(crs)}, the tiles at {edges(ground)} in {short(target)}"
    for why, source, moved in _mistakes(crs, bounds, target, ground):
        placed = bounds_in(target, source, moved)
        if np.isfinite(placed).all() and overlap(placed, ground, -reach_m):
            return f"{text}; {why}"
    return f"{text}; correct its CRS"


def _mistakes(crs: str, bounds: Bounds, target: str, ground: Bounds) -> Iterator[tuple[str, str, Bounds]]:
    """Yield known mistakes, each with the true CRS and bounds of the layer if this mistake was made."""
    west, south, east, north = bounds
    yield "its axes are swapped: give easting before northing", crs, (south, west, north, east)
    here = bounds_in(crs, target, ground)
    shift = round((west + east - here[0] - here[2]) / 2 / ZONE) * ZONE if np.isfinite(here).all() else 0.0
    if shift and is_projected(crs):
        zoned = ZONED.get(in_plan(crs)) if shift > 0 else None
        remedy = f"declare {zoned}" if zoned else f"move it by {-shift:.0f} m"
        why = f"its eastings differ by {shift:.0f}, the number of a zone: {remedy}"
        yield why, crs, (west - shift, south, east - shift, north)
    if is_projected(crs) and may_be_in("EPSG:4326", bounds):
        yield "its coordinates are degrees: declare EPSG:4326", "EPSG:4326", bounds
        swapped = (south, west, north, east)
        yield (
            "its coordinates are degrees, latitude first: swap its axes, declare EPSG:4326",
            "EPSG:4326",
            swapped,
        )
