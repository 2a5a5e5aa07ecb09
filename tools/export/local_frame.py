"""A local transverse Mercator projection without scale, shared by the road formats.

Simulators take coordinates as metres on the ground. UTM is 0.04% off, and its large numbers do not fit in
float32. Here the central meridian runs through the area, and its scale is 1: at 10 km from it the error is
1.2 mm per km.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from pyproj import CRS, Transformer

from flexroad.catalog import crs as crs_of
from flexroad.tasks.types import Floats

DIGITS = 5
"""Digits of the origin's longitude and latitude (degrees): about 1 m."""
ELLIPSOIDS = {"GRS 1980": "GRS80", "WGS 84": "WGS84"}
"""Ellipsoids that programs take as that of GNSS, with PROJ's names."""


@dataclass(frozen=True)
class LocalFrame:
    """x to the east, y to the north (m) from a point; heights stay as they are."""

    crs: str
    """CRS of the run."""
    longitude: float
    latitude: float
    """The origin (degrees), in the datum of the run or, if its ellipsoid is another, in WGS 84."""

    @classmethod
    def around(cls, crs: str, easting: float, northing: float) -> LocalFrame:
        """Return the frame with its origin near a point of a run (m, in its CRS)."""
        to_degrees = Transformer.from_crs(_plan(crs), _geodetic(crs), always_xy=True)
        longitude, latitude = to_degrees.transform(easting, northing, errcheck=True)
        return cls(crs, round(longitude, DIGITS), round(latitude, DIGITS))

    @property
    def proj(self) -> str:
        """The projection as a PROJ string.

        CARLA reads ``lat_0`` and ``lon_0`` alone; esmini rejects ``+no_defs``.
        """
        geodetic = _geodetic(self.crs)
        assert geodetic.ellipsoid is not None
        return (
            f"+proj=tmerc +lat_0={self.latitude:.{DIGITS}f} +lon_0={self.longitude:.{DIGITS}f} +k=1 "
            f"+x_0=0 +y_0=0 +ellps={ELLIPSOIDS[geodetic.ellipsoid.name]} +units=m"
        )

    def to_local(self, easting: Floats, northing: Floats) -> tuple[Floats, Floats]:
        """Return x and y of points of the run."""
        x, y = self._transformer.transform(easting, northing, errcheck=True)
        return np.asarray(x, float), np.asarray(y, float)

    def to_run(self, x: Floats, y: Floats) -> tuple[Floats, Floats]:
        """Return easting and northing, in the run's CRS, of points of the frame."""
        easting, northing = self._transformer.transform(x, y, direction="INVERSE", errcheck=True)
        return np.asarray(easting, float), np.asarray(northing, float)

    @cached_property
    def _transformer(self) -> Transformer:
        geodetic = _geodetic(self.crs).to_json_dict()
        metre = {"type": "LinearUnit", "name": "metre", "conversion_factor": 1}
        values = {
            "Latitude of natural origin": (self.latitude, "degree"),
            "Longitude of natural origin": (self.longitude, "degree"),
            "Scale factor at natural origin": (1, "unity"),
            "False easting": (0, metre),
            "False northing": (0, metre),
        }
        local = {
            "type": "ProjectedCRS",
            "name": "local transverse Mercator",
            "base_crs": geodetic,
            "conversion": {
                "name": "local",
                "method": {"name": "Transverse Mercator", "id": {"authority": "EPSG", "code": 9807}},
                "parameters": [{"name": k, "value": v, "unit": u} for k, (v, u) in values.items()],
            },
            "coordinate_system": {
                "subtype": "Cartesian",
                "axis": [
                    {"name": "Easting", "abbreviation": "E", "direction": "east", "unit": "metre"},
                    {"name": "Northing", "abbreviation": "N", "direction": "north", "unit": "metre"},
                ],
            },
        }
        return Transformer.from_crs(_plan(self.crs), CRS.from_json_dict(local), always_xy=True)


def _plan(crs: str) -> CRS:
    return CRS.from_user_input(crs_of.in_plan(crs)).to_2d()


def _geodetic(crs: str) -> CRS:
    """Return the run's geographic CRS, or WGS 84 if programs would mistake its ellipsoid."""
    geodetic = _plan(crs).geodetic_crs
    known = geodetic is not None and geodetic.ellipsoid is not None and geodetic.ellipsoid.name in ELLIPSOIDS
    return geodetic if known and geodetic is not None else CRS.from_epsg(4326)
