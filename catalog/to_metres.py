"""From a source's CRS and units to metres: converted at the door, once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flexroad.catalog.crs import (
    degrees,
    height_unit,
    in_plan,
    is_geographic,
    is_projected,
    metric_twin,
    plan_unit,
    same,
    short,
    transformer,
    utm_of,
)
from flexroad.catalog.errors import CatalogError

Floats = NDArray[np.float64]

HEIGHT_UNITS = {"metre": 1.0, "foot": 0.3048, "us-foot": 1200 / 3937}
"""Metres in the units that heights come in; the two feet differ by 2 ppm."""
SAME_UNIT = 1e-9
"""Units closer than this, relatively, are one: registers round the survey foot."""


@dataclass(frozen=True)
class MetricTransform:
    """How coordinates of a source become eastings, northings and heights in metres."""

    source: str
    """CRS of the source."""
    target: str
    """Projected CRS in metres."""
    plan_m: float | None
    """Metres per unit in plan where the target is the twin in metres; None where the plan is reprojected."""
    height_m: float
    """Metres per unit of height; heights are not moved to another datum."""
    notes: tuple[str, ...] = ()
    """What had to be assumed."""

    @classmethod
    def of(
        cls,
        source: str,
        place: tuple[float, float],
        to_crs: str | None = None,
        unit: str | None = None,
    ) -> MetricTransform:
        """Return the way from a CRS to metres.

        Parameters
        ----------
        source : str
            CRS of the coordinates: projected in any unit, or geographic.
        place : tuple[float, float]
            Easting and northing (or longitude and latitude) of any place of the data.
        to_crs : str, optional
            Projected CRS in metres to go to; by default the same projection in metres, and of a
            geographic CRS the UTM zone of the place.
        unit : str, optional
            Unit of heights, one of `HEIGHT_UNITS`, where the CRS does not say.

        Raises
        ------
        CatalogError
            If one of the CRSs is unfit, or the unit unknown or not that of the CRS.
        """
        if not (is_projected(source) or is_geographic(source)):
            raise CatalogError(f"{short(source)} is neither projected nor geographic; reproject the source")
        height_m, notes = _heights(source, unit)
        twin = _target(source, place)
        target = _asked(to_crs) if to_crs else twin
        exact = is_projected(source) and same(target, twin)
        return cls(source, target, plan_unit(source)[1] if exact else None, height_m, notes)

    def metres(self, x: Floats, y: Floats, z: Floats) -> tuple[Floats, Floats, Floats]:
        """Return eastings, northings and heights in metres, ``(n,)`` each.

        Raises
        ------
        CatalogError
            If a place lies where the target has no coordinates.
        """
        height = z * self.height_m
        if self.plan_m is not None:
            return x * self.plan_m, y * self.plan_m, height
        easting, northing = transformer(self.source, self.target).transform(x, y)
        if not (np.isfinite(easting).all() and np.isfinite(northing).all()):
            raise CatalogError(
                f"points in {short(self.source)} lie nowhere in {short(self.target)}; "
                "give a CRS made for their place with --to-crs, or correct --crs"
            )
        return easting, northing, height


def agreed(told: Sequence[tuple[str, str | None]], given: str | None) -> str:
    """Return the one CRS of a set of files.

    Parameters
    ----------
    told : Sequence[tuple[str, str or None]]
        Name and CRS of each file, one at least.
    given : str, optional
        CRS of the files that carry none.

    Raises
    ------
    CatalogError
        If a file has no CRS and none is given, or two differ in plan or in the unit of their heights; the
        given one counts as that of every file.
    """
    crs_of = [(name, crs) for name, crs in told if crs]
    bare = next((name for name, crs in told if not crs), None)
    if given:
        crs_of.append(("--crs", given))
    elif bare is not None:
        raise CatalogError(f"{bare} carries no CRS; give it with --crs, such as --crs EPSG:25832")
    first, one = crs_of[0]
    for name, crs in crs_of[1:]:
        if same(one, crs) and _equal(_implied(one), _implied(crs)):
            continue
        remedy = "leave --crs out" if name == "--crs" else "prepare them apart, or reproject one"
        raise CatalogError(f"mixed CRS: {first} is in {_full(one)}, {name} in {_full(crs)}; {remedy}")
    return next((crs for _, crs in crs_of if height_unit(crs)), one)


def _target(source: str, place: tuple[float, float]) -> str:
    if is_projected(source):
        return metric_twin(source, *place)
    longitude, latitude = degrees(source, *place)
    return utm_of((longitude, latitude, longitude, latitude))


def _asked(to_crs: str) -> str:
    if not is_projected(to_crs) or plan_unit(to_crs)[1] != 1:
        raise CatalogError(
            f"--to-crs {to_crs} is in {_units(to_crs)}; give a projected CRS in metres, such as EPSG:25832"
        )
    return in_plan(to_crs)


def _heights(source: str, unit: str | None) -> tuple[float, tuple[str, ...]]:
    """Return metres per unit of height, and a note where the unit is but assumed."""
    if unit is not None and unit not in HEIGHT_UNITS:
        raise CatalogError(f"--height-unit {unit}: there is {', '.join(HEIGHT_UNITS)}")
    told = height_unit(source)
    if told:
        if unit and not _equal(told[1], HEIGHT_UNITS[unit]):
            raise CatalogError(
                f"--height-unit {unit}, but heights of {_full(source)} are in {told[0]}; "
                "leave --height-unit out, or correct the CRS of the file"
            )
        return told[1], ()
    if unit:
        return HEIGHT_UNITS[unit], ()
    implied = _implied(source)
    if is_geographic(source) or implied == 1:
        return implied, ()
    unit = _units(source)
    return implied, (f"heights are taken to be in {unit}, like the plan; --height-unit metre otherwise",)


def _implied(crs: str) -> float:
    """Return metres per unit of height: what the CRS says, else as in plan; metres over degrees."""
    told = height_unit(crs)
    if told:
        return told[1]
    return 1.0 if is_geographic(crs) else plan_unit(crs)[1]


def _units(crs: str) -> str:
    """Return the unit in plan, in the plural."""
    unit = plan_unit(crs)[0]
    return unit.replace("foot", "feet") if "foot" in unit else f"{unit}s"


def _equal(a: float, b: float) -> bool:
    return abs(a - b) <= SAME_UNIT * abs(a)


def _full(crs: str) -> str:
    """Return a CRS as it reads in one line, with the unit of its heights if it says."""
    unit = height_unit(crs)
    return f"{short(crs)} with heights in {unit[0]}" if unit else short(crs)
