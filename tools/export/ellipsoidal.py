"""Heights above the ellipsoid of WGS 84, for formats that need them.

The conversion is given by the user and never guessed: without the geoid's grid, PROJ returns heights of a
vertical CRS unchanged and says nothing, unless ballpark transformations are excluded.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pyproj import Transformer
from pyproj.exceptions import ProjError

from flexroad.catalog.crs import compound, short
from flexroad.catalog.errors import CatalogError

Floats = NDArray[np.float64]
GEOGRAPHIC, GEOCENTRIC = "EPSG:4979", "EPSG:4978"
"""WGS 84 as longitude, latitude and ellipsoidal height, and as coordinates from the Earth's centre."""
Kind = Literal["crs", "geoid", "offset"]


@dataclass(frozen=True)
class Datum:
    """How heights of a run become heights above the ellipsoid."""

    kind: Kind
    value: str
    """The vertical CRS (EPSG:7837), the file of a geoid (GTX or GeoTIFF), or a number of metres."""

    def __post_init__(self) -> None:
        if self.kind == "geoid" and not Path(self.value).is_file():
            raise CatalogError(f"--geoid {self.value} does not exist")
        if self.kind == "offset" and not np.isfinite(float(self.value)):
            raise CatalogError(f"--height-offset {self.value} is no number of metres")

    @property
    def text(self) -> str:
        """The datum in words, for manifests."""
        return {
            "crs": f"heights of {self.value}",
            "geoid": f"heights above the geoid {Path(self.value).name}",
            "offset": f"heights plus {self.value} m are above the ellipsoid",
        }[self.kind]


@dataclass(frozen=True)
class Ellipsoidal:
    """Conversion of eastings, northings and heights to WGS 84."""

    crs: str
    """The horizontal CRS."""
    datum: Datum

    def geographic(self, easting: Floats, northing: Floats, height: Floats) -> tuple[Floats, Floats, Floats]:
        """Return longitude and latitude (degrees) and height above the ellipsoid (m), ``(n,)`` each."""
        try:
            if self.datum.kind == "crs":
                source = compound(self.crs, self.datum.value)
                return _transform(_exact(source, GEOGRAPHIC), easting, northing, height)
            longitude, latitude = _exact(self.crs, GEOGRAPHIC).transform(easting, northing, errcheck=True)
            if self.datum.kind == "offset":
                return longitude, latitude, height + float(self.datum.value)
            above = _transform(_geoid(self.datum.value), longitude, latitude, np.zeros_like(height))[2]
        except ProjError as error:
            raise CatalogError(self._failure(str(error))) from error
        if not np.isfinite(above).all():
            raise CatalogError(self._failure("the geoid does not cover the area"))
        return longitude, latitude, height + above

    def _failure(self, reason: str) -> str:
        return (
            f"no exact conversion from {short(self.crs)} and {self.datum.text} to the ellipsoid of WGS 84: "
            f"{reason}; give the geoid's grid with --geoid FILE, or a constant with --height-offset"
        )


def geocentric(longitude: Floats, latitude: Floats, height: Floats) -> Floats:
    """Return coordinates from the Earth's centre (m), ``(n, 3)``, of results of `Ellipsoidal.geographic`."""
    return np.stack(_transform(_exact(GEOGRAPHIC, GEOCENTRIC), longitude, latitude, height), axis=-1)


def _transform(transformer: Any, *axes: Floats) -> tuple[Floats, Floats, Floats]:
    x, y, z = transformer.transform(*axes, errcheck=True)
    return x, y, z


# A transformer takes longer to make than a tile to convert.
@lru_cache(maxsize=16)
def _exact(source: str, target: str) -> Any:
    return Transformer.from_crs(source, target, always_xy=True, allow_ballpark=False)


@lru_cache(maxsize=16)
def _geoid(file: str) -> Any:
    """Return the conversion of a height above a geoid to one above the ellipsoid."""
    return Transformer.from_pipeline(
        "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad "
        f'+step +proj=vgridshift +grids="{Path(file).resolve()}" +multiplier=1 '
        "+step +proj=unitconvert +xy_in=rad +xy_out=deg"
    )
