"""What a coordinate reference system says of plan and height, by one name for each."""

from __future__ import annotations

from functools import lru_cache

from pyproj import CRS
from pyproj.aoi import AreaOfInterest
from pyproj.database import query_utm_crs_info
from pyproj.exceptions import CRSError

from catalog.errors import CatalogError
from catalog.grid import Bounds

Unit = tuple[str, float]
"""Name of a unit of length (or angle) and how many metres (or radians) it has."""


@lru_cache(maxsize=256)
def _parts(text: str) -> tuple[CRS, CRS | None]:
    """Return the CRS in plan and, of a compound one, that of heights."""
    try:
        crs = CRS.from_user_input(text)
    except CRSError as error:
        raise CatalogError(f"unknown CRS {text[:60]!r}; give one like EPSG:25832") from error
    if not crs.is_compound:
        return crs.source_crs if crs.is_bound and crs.source_crs else crs, None
    plan, height = crs.sub_crs_list[:2]
    # Old files wrap their plan in a shift to WGS 84, which hides the code it has.
    return plan.source_crs if plan.is_bound and plan.source_crs else plan, height


@lru_cache(maxsize=256)
def in_plan(text: str) -> str:
    """Return the CRS in plan, without heights: ``EPSG:25832``, or WKT where there is no code.

    Raises
    ------
    CatalogError
        If ``text`` is no CRS.
    """
    plan, _ = _parts(text)
    code = plan.to_epsg()
    return f"EPSG:{code}" if code else plan.to_wkt()


@lru_cache(maxsize=256)
def same(a: str, b: str) -> bool:
    """Return whether two CRS are one in plan, whatever order their axes are named in."""
    return in_plan(a) == in_plan(b) or _parts(a)[0].equals(_parts(b)[0], ignore_axis_order=True)


def plan_unit(text: str) -> Unit:
    """Return the unit of eastings and northings; degrees for a geographic CRS."""
    axis = _parts(text)[0].axis_info[0]
    return axis.unit_name, axis.unit_conversion_factor


def height_unit(text: str) -> Unit | None:
    """Return the unit of heights, or None if the CRS says nothing of heights."""
    _, height = _parts(text)
    if height is None or not height.axis_info:
        return None
    return height.axis_info[0].unit_name, height.axis_info[0].unit_conversion_factor


def short(text: str) -> str:
    """Return the CRS as it reads in one line: its code, or its name where there is no code."""
    name = in_plan(text)
    return name if name.startswith("EPSG:") else _parts(text)[0].name


def utm_of(degrees: Bounds) -> str:
    """Return the code of the UTM zone (WGS 84) in the middle of west, south, east, north (degrees)."""
    east, north = (degrees[0] + degrees[2]) / 2, (degrees[1] + degrees[3]) / 2
    found = query_utm_crs_info("WGS 84", AreaOfInterest(east, north, east, north))
    return f"EPSG:{found[0].code}" if found else "EPSG:25832"
