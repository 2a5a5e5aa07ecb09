"""What a cell looks like and what lies around it: the features that `pixels` classifies.

Heights alone give a set; a photo adds its own. Neighbourhoods are Gaussian, cut at `CUT` standard
deviations and weighed over known cells only, so that voids and the grid's edge have no weight of their own
and a feature depends on no cell further away than `REACH_M`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flexroad.tasks.types import Orthophoto, TileData

Layer = NDArray[np.float32]
"""One value a cell, ``(H, W)``; NaN where unknown."""

SCALES_M = (1.0, 3.0, 9.0)
"""Standard deviations of the neighbourhoods (m): the texture of a lane, the width of a road, a square. Wider
ones tell a classifier which of its few tiles it is on."""
CUT = 3.0
REACH_M = 2 * CUT * SCALES_M[-1] + 2
"""What a feature can depend on (m): a tile with such a halo is classified as if it had no edge."""
ABOVE_M = (-5.0, 50.0)
"""Heights above ground are cut to these (m)."""
HIGHER_M = (0.4, 2.5)
"""Above the first (m) something stands on the ground; above the second it is a house or a tree."""
TINY = 1e-3
"""Weight of known cells below which a mean is unknown."""


@dataclass(frozen=True, eq=False)
class Features:
    """The features of all cells of a tile."""

    names: tuple[str, ...]
    values: NDArray[np.float32]
    """``(n, H, W)``, in the order of the names; NaN where unknown."""


def look(data: TileData) -> Orthophoto | None:
    """Return the tile's photo with four pixels a cell, or None if the tile has none.

    Raises
    ------
    TaskError
        As `read_photo`.
    """
    from flexroad.tasks.io.orthophoto import read_photo

    return read_photo(data.dop, data.grid, data.grid.cell / 2) if data.dop else None


def features(data: TileData, photo: Orthophoto | None) -> Features:
    """Return the features of a tile's cells.

    Parameters
    ----------
    data : TileData
    photo : Photo, optional
        As `look` gives it; without one there are only the features of heights.
    """
    found = dict(_of_heights(data))
    if photo is not None:
        found |= _of_colours(photo, data.grid.cell)
    return Features(tuple(found), np.stack(list(found.values())))


def _of_heights(data: TileData) -> Iterator[tuple[str, Layer]]:
    cell = data.grid.cell
    # Heights of a mountain town would leave float32 no millimetres; whole metres keep tiles alike.
    base = np.floor(np.nanmin(data.dtm)) if np.isfinite(data.dtm).any() else 0.0
    dtm, dsm = ((z - base).astype(np.float32) for z in (data.dtm, data.dsm))
    above = np.clip(data.dsm - data.dtm, *ABOVE_M).astype(np.float32)
    yield "above", above
    for scale in SCALES_M:
        yield f"above, mean {scale:g} m", mean(above, scale / cell)
        for height in HIGHER_M:
            higher = np.where(np.isfinite(above), above > height, np.nan).astype(np.float32)
            yield f"share above {height:g} m, {scale:g} m", mean(higher, scale / cell)
        yield from _relief("dsm", dsm, scale, cell)
        yield from _relief("dtm", dtm, scale, cell)


def _of_colours(photo: Orthophoto, cell: float) -> Iterator[tuple[str, Layer]]:
    fine = np.where(photo.known, photo.colour.astype(np.float32), np.float32(np.nan))
    red, green, blue = (_quarter(band) for band in fine)
    total = red + green + blue + 1
    light = (total / 3).astype(np.float32)
    most, least = np.maximum(np.maximum(red, green), blue), np.minimum(np.minimum(red, green), blue)
    layers = {
        "light": light,
        "greenness": (2 * green - red - blue) / total,
        "warmth": (red - blue) / total,
        "saturation": 1 - least / (most + 1),
    }
    yield from {"red": red, "green": green, "blue": blue, **layers}.items()
    shine = fine.mean(axis=0)
    yield "grain", np.sqrt(np.maximum(_quarter(shine**2) - _quarter(shine) ** 2, 0))
    for scale in SCALES_M:
        for name, layer in layers.items():
            yield f"{name}, mean {scale:g} m", mean(layer, scale / cell)
        yield from _relief("light", light, scale, cell)


def _relief(name: str, layer: Layer, scale: float, cell: float) -> Iterator[tuple[str, Layer]]:
    """Yield how a layer changes at a scale: its slope, what rises above it, and how rough that is."""
    level = mean(layer, scale / cell)
    south, east = np.gradient(level, cell)
    rise = layer - level
    yield f"{name}, slope {scale:g} m", np.hypot(south, east)
    yield f"{name}, rise {scale:g} m", rise
    # Against its own neighbourhood's mean: a slope alone is not rough.
    yield f"{name}, roughness {scale:g} m", np.sqrt(mean(rise**2, scale / cell))


def mean(layer: Layer, sigma: float) -> Layer:
    """Return the Gaussian mean over known cells, ``(H, W)``; ``sigma`` in cells."""
    import cv2

    size = 2 * int(np.ceil(CUT * sigma)) + 1
    known = np.isfinite(layer)
    filled = np.where(known, layer, np.float32(0))
    total, weight = (
        cv2.GaussianBlur(part, (size, size), sigma, borderType=cv2.BORDER_CONSTANT)
        for part in (filled, known.astype(np.float32))
    )
    level: Layer = np.where(weight > TINY, total / np.maximum(weight, TINY), np.float32(np.nan))
    return level


def _quarter(fine: Layer) -> Layer:
    """Return the mean of the four pixels of each cell."""
    height, width = fine.shape
    coarse: Layer = fine.reshape(height // 2, 2, width // 2, 2).mean(axis=(1, 3))
    return coarse
