"""Coarse images of meshes seen from above: pixels are means over their area, so that narrow roads stay."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from flexroad.catalog.grid import Bounds
from flexroad.tasks.metrics.mesh_distance import at_nodes
from flexroad.tasks.types import Bools, Floats

SAMPLES = 4
"""Places a pixel of `of_classes` is the mean of, from west to east and from north to south."""


@dataclass(frozen=True, eq=False)
class Aerial:
    """An image of the ground, row 0 in the north."""

    bounds: Bounds
    """West, south, east and north of its outer edges (m)."""
    colour: Floats
    """Red, green and blue, 0 to 255, ``(h, w, 3)``."""
    share: Floats
    """Share of each pixel that is known, 0 to 1, ``(h, w)``; the colour of one of 0 has no meaning."""

    def complete(self) -> NDArray[np.uint8]:
        """Return the colours, ``(h, w, 3)``; an unknown pixel has that of the nearest known one."""
        row, column = scipy.ndimage.distance_transform_edt(
            self.share == 0, return_distances=False, return_indices=True
        )
        return np.asarray(np.rint(self.colour[row, column]), np.uint8)


def of_classes(
    points: Floats,
    faces: NDArray[np.int32],
    road: Bools,
    colours: tuple[Sequence[int], Sequence[int]],
    bounds: Bounds,
    pixel_m: float,
) -> Aerial:
    """Return an image of a mesh with one colour for road and one for terrain.

    - `colours`: red, green and blue of road and of terrain, 0 to 255.
    - `pixel_m`: largest size of a pixel (m).
    """
    rows, columns = shape(bounds, pixel_m)
    west, south, east, north = bounds
    fine = rows * SAMPLES, columns * SAMPLES
    half_x, half_y = (east - west) / fine[1] / 2, (north - south) / fine[0] / 2
    centres = west + half_x, south + half_y, east - half_x, north - half_y
    covered, paved = (np.isfinite(at_nodes(points, kept, centres, fine)) for kept in (faces, faces[road]))

    def mean(mask: Bools) -> Floats:
        return np.asarray(mask.reshape(rows, SAMPLES, columns, SAMPLES).mean(axis=(1, 3)))

    share = mean(covered)
    part = (mean(paved) / np.where(share > 0, share, 1.0))[..., None]
    colour = part * np.asarray(colours[0], float) + (1 - part) * np.asarray(colours[1], float)
    return Aerial(bounds, colour, share)


def joined(parts: Sequence[Aerial], bounds: Bounds, pixel_m: float) -> Aerial:
    """Return one image of several over some bounds; where they overlap, the mean of them."""
    rows, columns = shape(bounds, pixel_m)
    west, south, east, north = bounds
    x, y = np.linspace(west, east, columns + 1), np.linspace(south, north, rows + 1)[::-1]
    colour, weight = np.zeros((rows, columns, 3)), np.zeros((rows, columns))
    for part in parts:
        height, width = part.share.shape
        across = _common(np.linspace(part.bounds[0], part.bounds[2], width + 1), x)
        along = _common(-np.linspace(part.bounds[3], part.bounds[1], height + 1), -y)
        # A part covers few of the pixels.
        row, column = (np.flatnonzero(lengths.any(axis=1)) for lengths in (along, across))
        along, across = along[row], across[column].T
        place = np.ix_(row, column)
        weight[place] += along @ part.share @ across
        known = part.share[..., None] * part.colour
        colour[place] += np.stack([along @ known[..., band] @ across for band in range(3)], axis=-1)
    area = (east - west) * (north - south) / (rows * columns)
    colour /= np.where(weight > 0, weight, 1.0)[..., None]
    return Aerial(bounds, colour, np.minimum(weight / area, 1.0))


def shape(bounds: Bounds, pixel_m: float) -> tuple[int, int]:
    """Return rows and columns of the smallest image with pixels of this size or less (m)."""
    west, south, east, north = bounds
    rows, columns = (max(1, int(np.ceil(length / pixel_m - 1e-6))) for length in (north - south, east - west))
    return rows, columns


def _common(parts: Floats, pixels: Floats) -> Floats:
    """Return the common length of each interval of pixels with each one of parts; ascending edges."""
    low = np.maximum(pixels[:-1, None], parts[None, :-1])
    high = np.minimum(pixels[1:, None], parts[None, 1:])
    return np.asarray(np.maximum(high - low, 0.0))
