"""Coordinates of exported files: relative to an origin, in a local projection, or on the ellipsoid.

Simulators take coordinates as metres on the ground. UTM is 0.04% off, and its large numbers do not fit in
float32. In the local projection of the road formats the central meridian runs through the area, and its scale
is 1: at 10 km from it the error is 1.2 mm per km.

The user gives the conversion to heights above the ellipsoid. It is never guessed: without the geoid's grid,
PROJ returns heights of a vertical CRS unchanged, unless ballpark transformations are excluded.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pyproj import CRS, Transformer
from pyproj.crs import ProjectedCRS
from pyproj.crs.coordinate_operation import TransverseMercatorConversion
from pyproj.exceptions import ProjError

from flexroad.catalog import crs as crs_of
from flexroad.catalog.crs import compound, short
from flexroad.catalog.errors import CatalogError
from flexroad.tasks.types import Floats

DIGITS = 5
"""Digits of the origin's longitude and latitude (degrees): about 1 m."""
ELLIPSOIDS = {"GRS 1980": "GRS80", "WGS 84": "WGS84"}
"""Ellipsoids that programs take for the ellipsoid of GNSS, with PROJ's names."""
GEOGRAPHIC, GEOCENTRIC = "EPSG:4979", "EPSG:4978"
"""WGS 84 as longitude, latitude and ellipsoidal height, and as coordinates from the Earth's centre."""


@dataclass(frozen=True)
class Georeference:
    """The place of local coordinates, in metres."""

    crs: str
    """CRS in metres: ``EPSG:25832``, or WKT if it has no code."""
    origin: tuple[float, float, float]
    """Easting, northing and height that local coordinates are relative to (m)."""
    vertical: str | None = None
    """CRS of the heights; None if unknown."""

    def lines(self) -> list[str]:
        """Return origin, CRS and vertical CRS as lines of ASCII text, for comments."""
        texts = [
            f"origin {' '.join(f'{v:.15g}' for v in self.origin)} (easting northing height, m)",
            f"crs {' '.join(self.crs.split())}",  # line breaks in WKT would end a comment
            f"vertical crs {' '.join(self.vertical.split()) if self.vertical else 'unknown'}",
        ]
        return [text.encode("ascii", "backslashreplace").decode() for text in texts]

    def sidecar(self, axes: str, **more: object) -> bytes:
        """Return the place as JSON, with the meaning of the axes and other entries.

        - `axes`: directions and units of the file's axes.
        - `more`: other entries, with values of JSON.
        """
        content = {
            "crs": self.crs,
            "crs_name": crs_of.name(self.crs),
            "vertical_crs": self.vertical,
            "origin": [float(v) for v in self.origin],
            "axes": axes,
            **more,
        }
        return json.dumps(content, indent=1, ensure_ascii=False, allow_nan=False).encode() + b"\n"

    def prj(self) -> bytes:
        """Return the horizontal CRS as a ``.prj`` file: WKT as ESRI writes it."""
        return crs_of.esri(self.crs).encode() + b"\n"


@dataclass(frozen=True)
class LocalFrame:
    """x to the east, y to the north (m) from a point; heights are unchanged."""

    crs: str
    """CRS of the run."""
    longitude: float
    latitude: float
    """The origin (degrees), in the run's datum, or in WGS 84 if programs do not know the run's ellipsoid."""

    @classmethod
    def around(cls, crs: str, easting: float, northing: float) -> LocalFrame:
        """Return the frame with its origin near a point of a run (m, in its CRS)."""
        to_degrees = Transformer.from_crs(_plan(crs), _geodetic(crs), always_xy=True)
        longitude, latitude = to_degrees.transform(easting, northing, errcheck=True)
        return cls(crs, round(longitude, DIGITS), round(latitude, DIGITS))

    @property
    def proj(self) -> str:
        """The projection as a PROJ string.

        CARLA reads only ``lat_0`` and ``lon_0``; esmini rejects ``+no_defs``.
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
        conversion = TransverseMercatorConversion(self.latitude, self.longitude, 0, 0, 1)
        local = ProjectedCRS(conversion, geodetic_crs=_geodetic(self.crs))
        return Transformer.from_crs(_plan(self.crs), local, always_xy=True)


def _plan(crs: str) -> CRS:
    return CRS.from_user_input(crs_of.in_plan(crs)).to_2d()


def _geodetic(crs: str) -> CRS:
    """Return the run's geographic CRS, or WGS 84 if programs do not know its ellipsoid."""
    geodetic = _plan(crs).geodetic_crs
    known = geodetic is not None and geodetic.ellipsoid is not None and geodetic.ellipsoid.name in ELLIPSOIDS
    return geodetic if known and geodetic is not None else CRS.from_epsg(4326)


@dataclass(frozen=True)
class Datum:
    """How heights of a run become heights above the ellipsoid."""

    kind: Literal["crs", "geoid", "offset"]
    value: str
    """The vertical CRS (EPSG:7837), the file of a geoid (GTX or GeoTIFF), or a number of metres."""

    @classmethod
    def of(cls, text: str) -> Datum:
        """Return the datum that a user gives: a number of metres, the file of a geoid, or a CRS."""
        try:
            return cls("offset", f"{float(text):g}")
        except ValueError:
            return cls("geoid" if text.lower().endswith((".gtx", ".tif", ".tiff")) else "crs", text)

    def __post_init__(self) -> None:
        if self.kind == "geoid" and not Path(self.value).is_file():
            raise CatalogError(f"--vertical {self.value} does not exist")
        if self.kind == "offset" and not np.isfinite(float(self.value)):
            raise CatalogError(f"--vertical {self.value} is not a number of metres")

    @property
    def text(self) -> str:
        """The datum in words, for manifests."""
        return {
            "crs": f"heights of {self.value}",
            "geoid": f"heights above the geoid {Path(self.value).name}",
            "offset": f"heights plus {self.value} m are above the ellipsoid",
        }[self.kind]

    def geographic(
        self, crs: str, easting: Floats, northing: Floats, height: Floats
    ) -> tuple[Floats, Floats, Floats]:
        """Return longitude and latitude (degrees) and height above the ellipsoid (m), ``(n,)`` each.

        - `crs`: horizontal CRS of the points.
        """
        reason = "the geoid does not cover the area"
        try:
            if self.kind == "crs":
                return _transform(_exact(compound(crs, self.value), GEOGRAPHIC), easting, northing, height)
            longitude, latitude = _exact(crs, GEOGRAPHIC).transform(easting, northing, errcheck=True)
            if self.kind == "offset":
                return longitude, latitude, height + float(self.value)
            above = _transform(_geoid(self.value), longitude, latitude, np.zeros_like(height))[2]
            if np.isfinite(above).all():
                return longitude, latitude, height + above
        except ProjError as error:
            reason = str(error)
        raise CatalogError(
            f"no exact conversion from {short(crs)} and {self.text} to the ellipsoid of WGS 84: {reason}; "
            "give the geoid's grid with --vertical FILE, or a constant with --vertical METRES"
        )


def geocentric(longitude: Floats, latitude: Floats, height: Floats) -> Floats:
    """Return geocentric coordinates (m), ``(n, 3)``, of results of `Datum.geographic`."""
    return np.stack(_transform(_exact(GEOGRAPHIC, GEOCENTRIC), longitude, latitude, height), axis=-1)


def _transform(transformer: Any, *axes: Floats) -> tuple[Floats, Floats, Floats]:
    x, y, z = transformer.transform(*axes, errcheck=True)
    return x, y, z


# To make a transformer takes longer than to convert a tile.
@lru_cache(maxsize=16)
def _exact(source: str, target: str) -> Any:
    return Transformer.from_crs(source, target, always_xy=True, allow_ballpark=False)


@lru_cache(maxsize=16)
def _geoid(file: str) -> Any:
    """Return the conversion of heights above a geoid to heights above the ellipsoid."""
    return Transformer.from_pipeline(
        "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad "
        f'+step +proj=vgridshift +grids="{Path(file).resolve()}" +multiplier=1 '
        "+step +proj=unitconvert +xy_in=rad +xy_out=deg"
    )
