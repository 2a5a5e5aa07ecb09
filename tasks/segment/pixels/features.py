"""Features of a cell and its neighbourhood, the input of the `pixels` classifier.

One set is computed from the heights; a photo adds a second one. Neighbourhoods are Gaussian, truncated at
`CUT` standard deviations. Means use valid cells only, so voids and cells beyond the grid have no weight, and
a feature depends on no cell further away than `REACH_M`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flexroad.tasks.types import Orthophoto, TileData

Layer = NDArray[np.float32]
"""One value per cell, ``(H, W)``; NaN if not available."""

SCALES_M = (1.0, 3.0, 9.0)
"""Standard deviations of the neighbourhoods (m): texture of a lane, width of a road, a square. With
wider ones a classifier recognises its few training tiles."""
CUT = 3.0
"""Radius of a neighbourhood in standard deviations."""
REACH_M = 2 * CUT * SCALES_M[-1] + 2
"""Greatest distance of a cell that a feature depends on (m). With this halo a tile's edge has no effect."""
ABOVE_M = (-5.0, 50.0)
"""Range that heights above ground are clipped to (m)."""
HIGHER_M = (0.4, 2.5)
"""Heights above ground (m) of any object, and of a house or a tree."""
TINY = 1e-3
"""Least weight of the valid cells; below it a mean is NaN."""


@dataclass(frozen=True, eq=False)
class Features:
    """The features of all cells of a tile."""

    names: tuple[str, ...]
    values: NDArray[np.float32]
    """``(n, H, W)``, in the order of the names; NaN if not available."""


def read_tile_photo(data: TileData) -> Orthophoto | None:
    """Return the tile's photo with four pixels per cell, or None if the tile has no photo.

    Raises
    ------
    TaskError
        See `read_photo`.
    """
    from flexroad.tasks.io.orthophoto import read_photo

    return read_photo(data.dop, data.grid, data.grid.cell / 2) if data.dop else None


def features(data: TileData, photo: Orthophoto | None) -> Features:
    """Return the features of a tile's cells.

    Parameters
    ----------
    data : TileData
    photo : Orthophoto, optional
        From `read_tile_photo`; without it only the features of the heights are computed.
    """
    layers = dict(_height_features(data))
    if photo is not None:
        layers |= _colour_features(photo, data.grid.cell)
    return Features(tuple(layers), np.stack(list(layers.values())))


def _height_features(data: TileData) -> Iterator[tuple[str, Layer]]:
    cell = data.grid.cell
    # Subtracted because float32 has no millimetres at great heights; a whole metre, so tiles round alike.
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


def _colour_features(photo: Orthophoto, cell: float) -> Iterator[tuple[str, Layer]]:
    fine = np.where(photo.known, photo.colour.astype(np.float32), np.float32(np.nan))
    red, green, blue = (_cell_mean(band) for band in fine)
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
    brightness = fine.mean(axis=0)
    variance = _cell_mean(brightness**2) - _cell_mean(brightness) ** 2
    yield "grain", np.sqrt(np.maximum(variance, 0))
    for scale in SCALES_M:
        for name, layer in layers.items():
            yield f"{name}, mean {scale:g} m", mean(layer, scale / cell)
        yield from _relief("light", light, scale, cell)


def _relief(name: str, layer: Layer, scale: float, cell: float) -> Iterator[tuple[str, Layer]]:
    """Yield slope, rise (layer minus its mean) and roughness of a layer at a scale."""
    level = mean(layer, scale / cell)
    south, east = np.gradient(level, cell)
    rise = layer - level
    yield f"{name}, slope {scale:g} m", np.hypot(south, east)
    yield f"{name}, rise {scale:g} m", rise
    # Relative to the mean of the neighbourhood: a plane slope has no roughness.
    yield f"{name}, roughness {scale:g} m", np.sqrt(mean(rise**2, scale / cell))


def mean(layer: Layer, sigma: float) -> Layer:
    """Return the Gaussian mean over the valid cells, ``(H, W)``; ``sigma`` in cells."""
    import cv2

    size = 2 * int(np.ceil(CUT * sigma)) + 1
    valid = np.isfinite(layer)
    filled = np.where(valid, layer, np.float32(0))
    total, weight = (
        cv2.GaussianBlur(part, (size, size), sigma, borderType=cv2.BORDER_CONSTANT)
        for part in (filled, valid.astype(np.float32))
    )
    level: Layer = np.where(weight > TINY, total / np.maximum(weight, TINY), np.float32(np.nan))
    return level


def _cell_mean(fine: Layer) -> Layer:
    """Return the mean of the four pixels of each cell."""
    height, width = fine.shape
    coarse: Layer = fine.reshape(height // 2, 2, width // 2, 2).mean(axis=(1, 3))
    return coarse
