"""Conversion of coordinates and heights from a source's CRS and units to metres."""

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
    plan_units,
    same,
    short,
    transformer,
    utm_of,
    vertical,
)
from flexroad.catalog.errors import CatalogError

Floats = NDArray[np.float64]

HEIGHT_UNITS = {"metre": 1.0, "foot": 0.3048, "us-foot": 1200 / 3937}
"""Size of the supported units of height (m); the two feet differ by 2 ppm."""
SAME_UNIT = 1e-9
"""Relative difference up to which two units are equal: registers round the survey foot."""


@dataclass(frozen=True)
class MetricTransform:
    """Conversion of a source's coordinates to eastings, northings and heights in metres."""

    source: str
    """CRS of the source."""
    target: str
    """Projected CRS in metres."""
    plan_m: float | None
    """Metres per horizontal unit if the target is the same projection in metres; None if coordinates are
    reprojected."""
    height_m: float
    """Metres per unit of height; the vertical datum is not changed."""
    notes: tuple[str, ...] = ()
    """Assumptions, one line each."""

    @classmethod
    def of(
        cls,
        source: str,
        place: tuple[float, float],
        to_crs: str | None = None,
        unit: str | None = None,
    ) -> MetricTransform:
        """Return the conversion from a CRS to metres.

        - `source`: CRS of the coordinates: projected in any unit, or geographic.
        - `place`: easting and northing (or longitude and latitude) of any point of the data.
        - `to_crs`: projected target CRS in metres; by default the same projection in metres or, for a
          geographic CRS, the UTM zone of the point.
        - `unit`: unit of heights, one of `HEIGHT_UNITS`, if the CRS does not define it.
        """
        if not (is_projected(source) or is_geographic(source)):
            raise CatalogError(f"{short(source)} is neither projected nor geographic; reproject the source")
        height_m, notes = _heights(source, unit)
        if is_projected(source):
            twin = metric_twin(source, *place)
        else:
            longitude, latitude = degrees(source, *place)
            twin = utm_of((longitude, latitude, longitude, latitude))
        if to_crs and not (is_projected(to_crs) and plan_unit(to_crs)[1] == 1):
            remedy = "give a projected CRS in metres, such as EPSG:25832"
            raise CatalogError(f"--to-crs {to_crs} is in {plan_units(to_crs)}; {remedy}")
        target = in_plan(to_crs) if to_crs else twin
        exact = is_projected(source) and same(target, twin)
        return cls(source, target, plan_unit(source)[1] if exact else None, height_m, notes)

    @property
    def vertical(self) -> str | None:
        """Vertical CRS of the heights in metres, None if the source does not declare one."""
        return vertical(self.source)

    def metres(self, x: Floats, y: Floats, z: Floats) -> tuple[Floats, Floats, Floats]:
        """Return eastings, northings and heights in metres, ``(n,)`` each."""
        height = z * self.height_m
        if self.plan_m is not None:
            return x * self.plan_m, y * self.plan_m, height
        easting, northing = transformer(self.source, self.target).transform(x, y)
        lost = ~(np.isfinite(easting) & np.isfinite(northing))
        if lost.any():
            at = int(np.argmax(lost))
            raise CatalogError(
                f"a point at {x[at]:.9g}, {y[at]:.9g} in {short(self.source)} has no position in "
                f"{short(self.target)}; "
                "give a CRS that is valid there with --to-crs, or correct --crs"
            )
        return easting, northing, height


def agreed(files: Sequence[tuple[str, str | None]], option: str | None) -> str:
    """Return the common CRS of a set of files.

    - `files`: name and CRS of each file, at least one.
    - `option`: CRS given with --crs, for files without one.
    """
    crs_of = [(name, crs) for name, crs in files if crs]
    bare = next((name for name, crs in files if not crs), None)
    if option:
        crs_of.append(("--crs", option))
    elif bare is not None:
        raise CatalogError(f"{bare} carries no CRS; give it with --crs, such as --crs EPSG:25832")
    first_name, first = crs_of[0]
    for name, crs in crs_of[1:]:
        if same(first, crs) and _equal(_implied(first), _implied(crs)):
            continue
        remedy = "leave --crs out" if name == "--crs" else "prepare them apart, or reproject one"
        raise CatalogError(f"mixed CRS: {first_name} is in {_full(first)}, {name} in {_full(crs)}; {remedy}")
    return next((crs for _, crs in crs_of if height_unit(crs)), first)


def _heights(source: str, unit: str | None) -> tuple[float, tuple[str, ...]]:
    """Return metres per unit of height, and a note if the unit is assumed."""
    if unit is not None and unit not in HEIGHT_UNITS:
        raise CatalogError(f"--height-unit {unit}: must be one of {', '.join(HEIGHT_UNITS)}")
    declared = height_unit(source)
    if declared:
        if unit and not _equal(declared[1], HEIGHT_UNITS[unit]):
            raise CatalogError(
                f"--height-unit {unit}, but heights of {_full(source)} are in {declared[0]}; "
                "leave --height-unit out, or correct the CRS of the file"
            )
        return declared[1], ()
    if unit:
        return HEIGHT_UNITS[unit], ()
    implied = _implied(source)
    if is_geographic(source) or implied == 1:
        return implied, ()
    unit = plan_units(source)
    return implied, (f"heights are assumed to be in {unit}, like x and y; if not, use --height-unit metre",)


def _implied(crs: str) -> float:
    """Return metres per unit of height: from the CRS, else the horizontal unit, or metres if geographic."""
    declared = height_unit(crs)
    if declared:
        return declared[1]
    return 1.0 if is_geographic(crs) else plan_unit(crs)[1]


def _equal(a: float, b: float) -> bool:
    return abs(a - b) <= SAME_UNIT * abs(a)


def _full(crs: str) -> str:
    """Return a short name of a CRS for messages, with its unit of heights if it defines one."""
    unit = height_unit(crs)
    return f"{short(crs)} with heights in {unit[0]}" if unit else short(crs)
