"""What a coordinate reference system says of plan and height, by one name for each."""

from __future__ import annotations

from functools import lru_cache

from pyproj import CRS, Transformer
from pyproj.aoi import AreaOfInterest
from pyproj.database import query_crs_info, query_utm_crs_info
from pyproj.enums import PJType
from pyproj.exceptions import CRSError

from flexroad.catalog.errors import CatalogError
from flexroad.catalog.grid import Bounds

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
    plan, height = _parts(text)
    axes = plan.axis_info[2:3] if height is None else height.axis_info[:1]
    return (axes[0].unit_name, axes[0].unit_conversion_factor) if axes else None


def is_geographic(text: str) -> bool:
    """Return whether eastings and northings are angles."""
    return _parts(text)[0].is_geographic


def is_projected(text: str) -> bool:
    """Return whether eastings and northings are lengths in a map's plane."""
    return _parts(text)[0].is_projected


def short(text: str) -> str:
    """Return the CRS as it reads in one line: its code, or its name where there is no code."""
    name = in_plan(text)
    return name if name.startswith("EPSG:") else _parts(text)[0].name


def utm_of(degrees: Bounds) -> str:
    """Return the code of the UTM zone (WGS 84) in the middle of west, south, east, north (degrees)."""
    east, north = (degrees[0] + degrees[2]) / 2, (degrees[1] + degrees[3]) / 2
    found = query_utm_crs_info("WGS 84", AreaOfInterest(east, north, east, north))
    return f"EPSG:{found[0].code}" if found else "EPSG:25832"


@lru_cache(maxsize=256)
def metric_twin(text: str, easting: float, northing: float) -> str:
    """Return the same projection in metres: its code in the EPSG register if it has one, else WKT.

    Parameters
    ----------
    text : str
        A projected CRS in any unit.
    easting, northing : float
        Any place of the data, in units of ``text``: of the many CRSs in the register only those that are
        made for this place are looked at.
    """
    plan = _parts(text)[0].to_2d()
    if plan.to_epsg() and plan.axis_info[0].unit_conversion_factor == 1:
        return in_plan(text)
    described = plan.to_json_dict()
    described.pop("id", None)
    for axis in described["coordinate_system"]["axis"]:
        axis["unit"] = "metre"
    for parameter in described["conversion"]["parameters"]:
        unit = parameter.get("unit")
        if isinstance(unit, dict) and unit["type"] == "LinearUnit":
            parameter.update(value=parameter["value"] * unit["conversion_factor"], unit="metre")
    twin = CRS.from_json_dict(described)
    return _registered(twin, *degrees(text, easting, northing)) or twin.to_wkt()


def _registered(crs: CRS, longitude: float, latitude: float) -> str | None:
    """Return the code of a projected CRS that is this one in all but name."""
    place = AreaOfInterest(longitude, latitude, longitude, latitude)
    method = crs.coordinate_operation.method_name if crs.coordinate_operation else ""
    for info in query_crs_info("EPSG", PJType.PROJECTED_CRS, area_of_interest=place, contains=True):
        if info.projection_method_name == method:
            known = CRS.from_epsg(info.code)
            if known.equals(crs, ignore_axis_order=True):
                return f"EPSG:{info.code}"
    return None


def degrees(text: str, easting: float, northing: float) -> tuple[float, float]:
    """Return longitude and latitude (WGS 84) of a place, infinite where the CRS has no such place."""
    longitude, latitude = transformer(text, "EPSG:4326").transform(easting, northing)
    return float(longitude), float(latitude)


@lru_cache(maxsize=16)
def transformer(source: str, target: str) -> Transformer:
    """Return what takes eastings and northings (or longitudes and latitudes) from one CRS to another."""
    return Transformer.from_crs(_parts(source)[0].to_2d(), _parts(target)[0].to_2d(), always_xy=True)
