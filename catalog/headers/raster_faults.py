"""Why a raster cannot be used: its georeference, or its bands where heights are needed."""

from __future__ import annotations

import math
from typing import Any

from rasterio.enums import ColorInterp

from flexroad.catalog.grid import FARTHEST
from flexroad.catalog.tile import ROAD_HEIGHT_BANDS

AGAIN = "give it its georeference with gdal_translate -a_ullr"
BANDS = tuple(name for name, _ in ROAD_HEIGHT_BANDS)


def georeference_fault(dataset: Any) -> str | None:
    """Return why the position of an open raster is no place, to follow its name; None if it is one."""
    # A dataset makes its transform anew each time.
    transform = dataset.transform
    east_step, _, west, _, north_step, north = transform[:6]
    if not all(map(math.isfinite, transform[:6])):
        cells = f"cells of {east_step:g} x {north_step:g}"
        return f"has the origin {west:g}, {north:g} and {cells}, which is no place; {AGAIN}"
    if not transform.determinant:
        return f"has cells of {east_step:g} x {north_step:g}; {AGAIN}"
    corners = (west, north, west + dataset.width * east_step, north + dataset.height * north_step)
    if max(map(abs, corners)) > FARTHEST:
        return (
            f"reaches from {west:g}, {north:g} to {corners[2]:g}, {corners[3]:g}, which is no place; {AGAIN}"
        )
    return None


def heights_fault(dataset: Any) -> str | None:
    """Return why an open raster has no heights, to follow its name; None if it has them.

    They are its only band of numbers, or the first one if its bands are described as `ROAD_HEIGHT_BANDS`.
    """
    kinds = [kind for kind in dataset.colorinterp if kind != ColorInterp.alpha]
    if len(kinds) > 1 and dataset.descriptions[: len(BANDS)] != BANDS:
        bands = f"{len(kinds)} bands ({', '.join(kind.name for kind in kinds[:4])})"
        return f"has {bands}, but heights are one; keep theirs with gdal_translate -b 1"
    if ColorInterp.palette in kinds:
        return "has a palette of colours, no heights; give a raster of heights"
    if dataset.dtypes[0].startswith("complex"):
        return f"has complex numbers ({dataset.dtypes[0]}), no heights; give a raster of heights"
    return None
