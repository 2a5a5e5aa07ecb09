"""3D Tiles 1.1: tilesets over the unchanged GLB files of a run, and over coarse meshes.

Meshes have coordinates of a map projection, and 3D Tiles have geocentric coordinates. One affine transform
per tile converts them: it is fitted to points of the tile's box. A rigid transform would ignore the scale of
the projection, 0.04% in the middle of a UTM zone: 79 mm at the corners of a tile of 250 m.

Coarse meshes are too large for this, as the Earth is curved. All their points are converted.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from flexroad.catalog.grid import Bounds
from flexroad.tasks.types import Floats
from flexroad.tools.export.georeference import Datum, Georeference, geocentric

VERSION = 3
ASSET = {"version": "1.1", "generator": "FlexRoad"}
MARGIN_M = 1.0
"""Height added below and above a tile's box (m): bounding volumes must contain all vertices."""
EDGE_M = 0.1
"""Length added around a region (m): for errors of transforms and float32, and for curved edges."""
RADIUS_M = 6_378_137.0
"""Radius of the Earth (m), to convert angles to lengths."""


def placed(
    uri: str,
    bounds: Bounds,
    heights: tuple[float, float],
    place: Georeference,
    datum: Datum,
) -> dict[str, Any]:
    """Return the place of a tile's mesh on the Earth: entries of its row.

    The transform is an affine matrix, 4 x 4 by columns, from the run's coordinates (east, north, up from its
    origin) to geocentric coordinates (m). The region is west, south, east, north (radians), lowest and
    highest height above the ellipsoid (m).

    - `heights`: lowest and highest height of the mesh (m).
    - `place`: origin of the coordinates in the run's GLB files.
    """
    west, south, east, north = bounds
    low, high = heights[0] - MARGIN_M, heights[1] + MARGIN_M
    axes = np.meshgrid(np.linspace(west, east, 5), np.linspace(south, north, 5), [low, high])
    points = np.stack([axis.ravel() for axis in axes], axis=1)
    longitude, latitude, height = datum.geographic(place.crs, *points.T)
    exact = geocentric(longitude, latitude, height)
    local = points - place.origin
    # Centred: the squares of large coordinates would lose digits.
    middle, centre = local.mean(axis=0), exact.mean(axis=0)
    linear = np.linalg.lstsq(local - middle, exact - centre, rcond=None)[0].T
    shift = centre - linear @ middle
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = linear, shift
    return {"uri": uri, "transform": _columns(matrix), "region": _region(longitude, latitude, height)}


def sheet_placed(uri: str, points: Floats, crs: str, datum: Datum) -> tuple[dict[str, Any], Floats]:
    """Convert all points of a mesh; return its place on the Earth, and its points in the frame of its tile.

    - result: the transform is from east, north and up at the middle of the points.
    - result ``(V, 3)``: the points in that frame (m), which float32 stores with 0.2 mm at 4 km.
    """
    longitude, latitude, height = datum.geographic(crs, *points.T)
    middle = [float(axis.min() + axis.max()) / 2 for axis in (longitude, latitude, height)]
    matrix = east_north_up(*middle)
    local = (geocentric(longitude, latitude, height) - matrix[:3, 3]) @ matrix[:3, :3]
    region = _region(longitude, latitude, height)
    return {"uri": uri, "transform": _columns(matrix), "region": region}, local


def east_north_up(longitude: float, latitude: float, height: float) -> Floats:
    """Return the matrix, ``(4, 4)``, from east, north and up at a place to geocentric coordinates.

    Longitude and latitude are in degrees, the height above the ellipsoid in metres.
    """
    lam, phi = np.radians([longitude, latitude])
    matrix = np.eye(4)
    matrix[:3, 0] = -np.sin(lam), np.cos(lam), 0.0
    matrix[:3, 2] = np.cos(phi) * np.cos(lam), np.cos(phi) * np.sin(lam), np.sin(phi)
    matrix[:3, 1] = np.cross(matrix[:3, 2], matrix[:3, 0])
    matrix[:3, 3] = geocentric(*(np.array([value]) for value in (longitude, latitude, height)))[0]
    return matrix


def tile(
    content: Mapping[str, Any],
    error_m: float,
    parent: Mapping[str, Any] | None = None,
    children: Sequence[dict[str, Any]] = (),
    **extras: Any,
) -> dict[str, Any]:
    """Return the entry of a tile.

    - `error_m`: error if it is shown instead of the finest tiles (m).
    - `parent`: the mesh of its parent tile, whose transform also applies to its children.
    """
    matrix = np.reshape(content["transform"], (4, 4)).T
    if parent:
        outer = np.reshape(parent["transform"], (4, 4)).T
        matrix[:3, 3] -= outer[:3, 3]
        # The outer frame is rigid: its inverse is its transpose.
        matrix[:3] = outer[:3, :3].T @ matrix[:3]
    regions = [content["region"], *(child["boundingVolume"]["region"] for child in children)]
    entry = {
        "boundingVolume": {"region": around(regions)},
        "geometricError": error_m,
        "transform": _columns(matrix),
        "content": {"uri": content["uri"]},
    }
    if children:
        entry |= {"refine": "REPLACE", "children": list(children)}
    return entry | ({"extras": extras} if extras else {})


def around(regions: Sequence[Sequence[float]]) -> list[float]:
    """Return the smallest region that contains one or more regions."""
    edges = np.array(regions)
    low, high = edges.min(axis=0), edges.max(axis=0)
    return [float(edge) for edge in (low[0], low[1], high[2], high[3], low[4], high[5])]


def tileset(root: dict[str, Any], error_m: float, **extras: Any) -> dict[str, Any]:
    """Return a tileset of a tile; ``error_m`` is the error if nothing is shown instead (m)."""
    asset = ASSET | ({"extras": extras} if extras else {})
    return {"asset": asset, "geometricError": error_m, "root": root}


def group(children: Sequence[dict[str, Any]], error_m: float) -> dict[str, Any]:
    """Return a tile without a mesh; ``error_m`` is the error if its children are not shown (m)."""
    region = around([child["boundingVolume"]["region"] for child in children])
    return {
        "boundingVolume": {"region": region},
        "geometricError": error_m,
        "refine": "ADD",
        "children": list(children),
    }


def extent_m(region: Sequence[float]) -> float:
    """Return the length of the diagonal of a region in plan (m)."""
    west, south, east, north = region[:4]
    return RADIUS_M * float(np.hypot((east - west) * np.cos((south + north) / 2), north - south))


def _columns(matrix: Floats) -> tuple[float, ...]:
    return tuple(matrix.T.ravel().tolist())


def _region(longitude: Floats, latitude: Floats, height: Floats) -> tuple[float, ...]:
    """Return the region around places on the Earth, with a margin of `EDGE_M`."""
    low, high = np.radians([longitude.min(), latitude.min()]), np.radians([longitude.max(), latitude.max()])
    margin = EDGE_M / RADIUS_M / np.array([np.cos(high[1]), 1.0])
    heights = float(height.min()) - EDGE_M, float(height.max()) + EDGE_M
    return (*(low - margin).tolist(), *(high + margin).tolist(), *heights)
