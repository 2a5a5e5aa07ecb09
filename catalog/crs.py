"""Coordinate reference systems (CRS): names, units and transformations of their plan and height parts.

"Plan" is the horizontal part, without heights.
"""

from __future__ import annotations

import math
from functools import lru_cache

from pyproj import CRS, Transformer
from pyproj.aoi import AreaOfInterest
from pyproj.crs import CompoundCRS
from pyproj.database import query_crs_info, query_utm_crs_info
from pyproj.enums import PJType
from pyproj.exceptions import CRSError, ProjError

from flexroad.catalog.errors import CatalogError
from flexroad.catalog.grid import Bounds

Unit = tuple[str, float]
"""Name of a unit of length (or angle) and its size in metres (or radians)."""


@lru_cache(maxsize=256)
def _parts(text: str) -> tuple[CRS, CRS | None]:
    """Return the horizontal CRS, and the vertical CRS or None."""
    try:
        crs = CRS.from_user_input(text)
    except CRSError as error:
        raise CatalogError(f"unknown CRS {text[:60]!r}; give one like EPSG:25832") from error
    if not crs.is_compound:
        return crs.source_crs if crs.is_bound and crs.source_crs else crs, None
    plan, height = crs.sub_crs_list[:2]
    # Old files wrap the horizontal CRS in a bound CRS with a shift to WGS 84, which hides its EPSG code.
    return plan.source_crs if plan.is_bound and plan.source_crs else plan, height


@lru_cache(maxsize=256)
def in_plan(text: str) -> str:
    """Return the horizontal CRS, without heights: ``EPSG:25832``, or WKT where there is no code."""
    plan, _ = _parts(text)
    code = plan.to_epsg()
    return f"EPSG:{code}" if code else plan.to_wkt()


@lru_cache(maxsize=256)
def same(a: str, b: str) -> bool:
    """Return whether two CRSs are the same horizontally; the order of axes does not matter."""
    return in_plan(a) == in_plan(b) or _parts(a)[0].equals(_parts(b)[0], ignore_axis_order=True)


def plan_unit(text: str) -> Unit:
    """Return the unit of eastings and northings; degrees for a geographic CRS."""
    axis = _parts(text)[0].axis_info[0]
    return axis.unit_name, axis.unit_conversion_factor


def plan_units(text: str) -> str:
    """Return the name of the unit of eastings and northings in the plural, for messages."""
    unit = plan_unit(text)[0]
    return unit.replace("foot", "feet") if "foot" in unit else f"{unit}s"


def height_unit(text: str) -> Unit | None:
    """Return the unit of heights, or None if the CRS has no height axis."""
    plan, height = _parts(text)
    axes = plan.axis_info[2:3] if height is None else height.axis_info[:1]
    return (axes[0].unit_name, axes[0].unit_conversion_factor) if axes else None


@lru_cache(maxsize=256)
def vertical(text: str) -> str | None:
    """Return the vertical CRS of heights in metres: ``EPSG:7837``, or WKT where there is no code.

    Of heights in feet it is the CRS of the same datum in metres. None if the CRS is not compound, or counts
    depths.
    """
    height = _parts(text)[1]
    if height is None:
        return None
    height = height.source_crs if height.is_bound and height.source_crs else height
    axis = height.axis_info[0]
    if axis.direction.lower() != "up":
        return None
    if axis.unit_conversion_factor != 1:
        height = _in_metres(height)
    code = height.to_epsg()
    return f"EPSG:{code}" if code else height.to_wkt()


def _in_metres(height: CRS) -> CRS:
    """Return the vertical CRS of the same datum in metres, of the EPSG register if it has one."""
    name = height.name.partition(" (")[0]
    for info in query_crs_info("EPSG", PJType.VERTICAL_CRS):
        if info.name == name:
            return CRS.from_epsg(info.code)
    definition = height.to_json_dict()
    definition.pop("id", None)
    definition["name"] = name
    definition["coordinate_system"]["axis"][0]["unit"] = "metre"
    return CRS.from_json_dict(definition)


@lru_cache(maxsize=256)
def compound(plan: str, height: str) -> str:
    """Return the compound CRS of a horizontal and a vertical CRS as WKT."""
    parts = [CRS.from_user_input(plan), CRS.from_user_input(height)]
    return str(CompoundCRS(" + ".join(part.name for part in parts), parts).to_wkt())


def is_geographic(text: str) -> bool:
    """Return whether the horizontal coordinates are angles."""
    return _parts(text)[0].is_geographic


def is_projected(text: str) -> bool:
    """Return whether the horizontal coordinates are lengths in a map projection."""
    return _parts(text)[0].is_projected


def short(text: str) -> str:
    """Return a short name of the CRS for messages: its code, or its name where there is no code."""
    name = in_plan(text)
    return name if name.startswith("EPSG:") else _parts(text)[0].name


def code(text: str) -> str | None:
    """Return the EPSG code of a CRS, such as ``25832``, or None. A compound CRS has a code of its own."""
    number = CRS.from_user_input(text).to_epsg()
    return str(number) if number else None


def name(text: str) -> str:
    """Return the full name of a CRS: ``ETRS89 / UTM zone 32N``."""
    return str(CRS.from_user_input(text).name)


def datum(text: str) -> str:
    """Return the name of the datum of a CRS that is not compound: ``Deutsches Haupthoehennetz 2016``."""
    known = CRS.from_user_input(text).datum
    return known.name if known else "unknown"


def esri(text: str) -> str:
    """Return a CRS as WKT in the dialect of ESRI's ``.prj`` files, in one line."""
    return CRS.from_user_input(text).to_wkt("WKT1_ESRI")


def utm_of(degrees: Bounds) -> str:
    """Return the code of the UTM zone (WGS 84) at the middle of bounds (degrees); any zone for NaN."""
    east, north = (degrees[0] + degrees[2]) / 2, (degrees[1] + degrees[3]) / 2
    known = math.isfinite(east) and math.isfinite(north)
    zones = query_utm_crs_info("WGS 84", AreaOfInterest(east, north, east, north)) if known else []
    return f"EPSG:{zones[0].code}" if zones else "EPSG:25832"


@lru_cache(maxsize=256)
def metric_twin(text: str, easting: float, northing: float) -> str:
    """Return the same projection in metres: its code in the EPSG register if it has one, else WKT.

    - `easting`, `northing`: any point of the data, in units of ``text``; only CRSs of the register that are
      valid at this point are considered.
    """
    plan = _parts(text)[0].to_2d()
    if plan.to_epsg() and plan.axis_info[0].unit_conversion_factor == 1:
        return in_plan(text)
    definition = plan.to_json_dict()
    definition.pop("id", None)
    for axis in definition["coordinate_system"]["axis"]:
        axis["unit"] = "metre"
    for parameter in definition["conversion"]["parameters"]:
        unit = parameter.get("unit")
        if isinstance(unit, dict) and unit["type"] == "LinearUnit":
            parameter.update(value=parameter["value"] * unit["conversion_factor"], unit="metre")
    twin = CRS.from_json_dict(definition)
    return _registered(twin, *degrees(text, easting, northing)) or twin.to_wkt()


def _registered(crs: CRS, longitude: float, latitude: float) -> str | None:
    """Return the EPSG code of a registered CRS with the same parameters, or None."""
    place = AreaOfInterest(longitude, latitude, longitude, latitude)
    method = crs.coordinate_operation.method_name if crs.coordinate_operation else ""
    for info in query_crs_info("EPSG", PJType.PROJECTED_CRS, area_of_interest=place, contains=True):
        if info.projection_method_name == method:
            registered = CRS.from_epsg(info.code)
            if registered.equals(crs, ignore_axis_order=True):
                return f"EPSG:{info.code}"
    return None


def degrees(text: str, easting: float, northing: float) -> tuple[float, float]:
    """Return longitude and latitude (WGS 84, degrees) of a point; infinite if it cannot be transformed."""
    longitude, latitude = transformer(text, "EPSG:4326").transform(easting, northing)
    return float(longitude), float(latitude)


def scales(source: str, target: str, x: float, y: float) -> tuple[float, float]:
    """Return the length of one unit of ``source`` along the two axes of ``target``, in units of ``target``.

    - `x`, `y`: a point, in ``source``.
    """
    step = 1e-5 if is_geographic(source) else 1.0
    xs, ys = transformer(source, target).transform([x - step, x + step, x, x], [y, y, y - step, y + step])
    across = math.hypot(xs[1] - xs[0], xs[3] - xs[2]) / (2 * step)
    along = math.hypot(ys[1] - ys[0], ys[3] - ys[2]) / (2 * step)
    return across, along


def bounds_in(target: str, source: str, bounds: Bounds) -> Bounds:
    """Return bounds transformed to another CRS; NaN if they cannot be transformed."""
    try:
        west, south, east, north = transformer(source, target).transform_bounds(*bounds, densify_pts=21)
    except ProjError:
        return (math.nan,) * 4
    return west, south, east, north


@lru_cache(maxsize=16)
def transformer(source: str, target: str) -> Transformer:
    """Return a transformer of horizontal coordinates from one CRS to another; x is east, y is north."""
    return Transformer.from_crs(_parts(source)[0].to_2d(), _parts(target)[0].to_2d(), always_xy=True)
