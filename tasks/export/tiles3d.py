"""3D Tiles 1.1: tilesets over the GLB files of a run, which stay as they are.

Meshes have coordinates of a map projection, and 3D Tiles those from the Earth's centre. One affine transform
per tile converts them: it is fitted to points of the tile's box. A rigid one would ignore the scale of the
projection, 0.04% in the middle of a UTM zone: 79 mm at the corners of a tile of 250 m.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from flexroad.catalog.ellipsoidal import Ellipsoidal, geocentric
from flexroad.catalog.grid import Bounds

VERSION = 1
NAME = ".json"
MEDIA_TYPE = "application/json"
ASSET = {"version": "1.1", "generator": "FlexRoad"}
MARGIN_M = 1.0
"""Height added below and above a tile's box (m): bounding volumes must contain all vertices."""


@dataclass(frozen=True)
class Placed:
    """A tile's mesh on the Earth."""

    uri: str
    """Path of the GLB, relative to the tileset."""
    transform: tuple[float, ...]
    """Affine matrix, 4 x 4 by columns, from the run's coordinates (east, north, up from its origin) to those
    from the Earth's centre (m)."""
    region: tuple[float, ...]
    """West, south, east, north (radians), lowest and highest height above the ellipsoid (m)."""
    residual_m: float
    """Largest distance of the transform from the exact conversion at the fitted points (m)."""


def placed(
    uri: str,
    bounds: Bounds,
    heights: tuple[float, float],
    origin: tuple[float, float],
    conversion: Ellipsoidal,
) -> Placed:
    """Return where a tile's mesh is on the Earth.

    Parameters
    ----------
    uri : str
        Path of the GLB, relative to the tileset.
    bounds : tuple of float
        West, south, east and north of the tile (m).
    heights : tuple of float
        Lowest and highest height of the mesh (m).
    origin : tuple of float
        Easting and northing of the run's origin (m), which the coordinates of its GLB files are relative to.
    conversion : Ellipsoidal
        From the CRS and the heights of the run to WGS 84.
    """
    west, south, east, north = bounds
    low, high = heights[0] - MARGIN_M, heights[1] + MARGIN_M
    axes = np.meshgrid(np.linspace(west, east, 5), np.linspace(south, north, 5), [low, high])
    points = np.stack([axis.ravel() for axis in axes], axis=1)
    longitude, latitude, height = conversion.geographic(*points.T)
    exact = geocentric(longitude, latitude, height)
    local = points - (*origin, 0.0)
    # Centred, so that the squares of large coordinates do not cost digits.
    middle, centre = local.mean(axis=0), exact.mean(axis=0)
    linear = np.linalg.lstsq(local - middle, exact - centre, rcond=None)[0].T
    shift = centre - linear @ middle
    residual = np.linalg.norm(local @ linear.T + shift - exact, axis=1).max()
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = linear, shift
    region = (
        *np.radians([longitude.min(), latitude.min(), longitude.max(), latitude.max()]),
        height.min(),
        height.max(),
    )
    return Placed(uri, tuple(matrix.T.ravel().tolist()), tuple(map(float, region)), float(residual))


def leaf(tile: Placed, error_m: float) -> dict[str, Any]:
    """Return the entry of a tile; ``error_m`` is the error of its mesh (m)."""
    return {
        "boundingVolume": {"region": list(tile.region)},
        "geometricError": error_m,
        "transform": list(tile.transform),
        "content": {"uri": tile.uri},
    }


def around(regions: Sequence[Sequence[float]]) -> list[float]:
    """Return the smallest region that contains others, at least one."""
    edges = np.array(regions)
    low, high = edges.min(axis=0), edges.max(axis=0)
    return [float(edge) for edge in (low[0], low[1], high[2], high[3], low[4], high[5])]


def tileset(children: Sequence[dict[str, Any]], error_m: float, **extras: Any) -> dict[str, Any]:
    """Return a tileset; ``error_m`` is the error of showing none of its children (m)."""
    region = around([child["boundingVolume"]["region"] for child in children])
    root = {
        "boundingVolume": {"region": region},
        "geometricError": error_m,
        "refine": "ADD",
        "children": list(children),
    }
    return {"asset": ASSET | ({"extras": extras} if extras else {}), "geometricError": error_m, "root": root}
