"""The surface as a field of heights for game engines and simulators: 16-bit PNG, R16 and MuJoCo's hfield.

The nodes of the field span its bounds: the first and the last column lie on the western and eastern edge,
the first and the last row on the northern and southern one. Heights are those of the surface at the nodes.
PNG and R16 have 65,536 values from the lowest to the highest height, so that a height is exact to half a
step; MuJoCo's file has float32 numbers from 0 to 1. None of the formats has a value for nodes without a
height, as beyond the survey: they have the height of the nearest node that has one. A mask of 8 bits has them
as holes, and the JSON file beside the field has their number.
"""

from __future__ import annotations

import io
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
import scipy
from numpy.typing import NDArray

from flexroad.catalog.grid import Bounds
from flexroad.catalog.lazy import lazy
from flexroad.tasks.errors import TaskError
from flexroad.tasks.georeference import Georeference
from flexroad.tasks.roads.extent import nodes_beyond
from flexroad.tasks.types import Floats, RoadMask, Surface

Image = lazy("PIL.Image")

VERSION = 4
NAME_PNG = "_heightfield.png"
NAME_R16 = "_heightfield.r16"
NAME_HOLES = "_holes.png"
NAME_MUJOCO = "_heightfield.bin"
NAME_SIDECAR = "_heightfield.json"
MEDIA_TYPE_PNG = "image/png"
MEDIA_TYPE = "application/octet-stream"

HOLE = 255
"""Value of a node without a height in the mask; others have 0."""
STEPS = 65535
"""Steps from the lowest to the highest value of 16 bits."""
SIZES: dict[str, tuple[int, ...]] = {
    "power": tuple(2**n + 1 for n in range(5, 14)),
    "unreal": (127, 253, 505, 1009, 2017, 4033, 8129),
}
"""Numbers of nodes along a side. power: 2^n + 1, for most engines; unreal: the sizes that Unreal Engine's
manual recommends for landscapes, which are whole numbers of sections of 63 or 127 quads."""
UNREAL_RANGE_M = STEPS / 128
"""Height range of an Unreal landscape with the scale 100 (m)."""
ROWS = 256
"""Rows that are evaluated at a time: memory for the basis stays small."""
FLAT_M = 1e-3
"""Height that a flat field is said to have in MuJoCo, which takes none of 0 (m)."""


@dataclass(frozen=True, eq=False)
class HeightField:
    """Heights at the nodes of a square lattice of points."""

    heights: Floats
    """``(n, n)``, m; row 0 on the northern edge, column 0 on the western one; NaN where unknown."""
    bounds: Bounds
    """West, south, east and north of the outermost nodes (m)."""
    low: float
    """Height of the value 0 (m)."""
    high: float
    """Height of the value 65535 (m)."""

    @property
    def spacing_m(self) -> tuple[float, float]:
        """Distance of neighbouring nodes along easting and northing (m)."""
        west, south, east, north = self.bounds
        rows, cols = self.heights.shape
        return (east - west) / (cols - 1), (north - south) / (rows - 1)

    @property
    def step_m(self) -> float:
        """Height of one step of 16 bits (m); a height is exact to half of it."""
        return (self.high - self.low) / STEPS

    @cached_property
    def filled(self) -> Floats:
        """Heights with that of the nearest node where there is none, ``(n, n)``, m."""
        unknown = np.isnan(self.heights)
        if not unknown.any():
            return self.heights
        across, along = self.spacing_m
        nearest = scipy.ndimage.distance_transform_edt(
            unknown, (along, across), return_distances=False, return_indices=True
        )
        return np.asarray(self.heights[tuple(nearest)])

    @property
    def values(self) -> NDArray[np.uint16]:
        """Heights in steps from the lowest one, ``(n, n)``."""
        steps = (self.filled - self.low) / (self.step_m or 1.0)
        return np.rint(steps).clip(0, STEPS).astype(np.uint16)


def size_at_spacing(bounds: Bounds, spacing_m: float, family: Literal["power", "unreal"] = "power") -> int:
    """Return the smallest number of nodes along a side whose distance is at most the given one.

    Raises
    ------
    TaskError
        If the largest size of the family is too small.
    """
    west, south, east, north = bounds
    span = max(east - west, north - south)
    for size in SIZES[family]:
        if span / (size - 1) <= spacing_m * (1 + 1e-9):
            return size
    size = SIZES[family][-1]
    raise TaskError(
        f"{span:g} m at {spacing_m:g} m need more than {size} x {size} nodes, the largest size of {family!r};"
        f" choose {span / (size - 1):.3g} m or more, or a smaller area"
    )


def sampled(
    surface: Surface,
    bounds: Bounds,
    size: int,
    limits: tuple[float, float] | None = None,
    road: RoadMask | None = None,
) -> HeightField:
    """Sample a surface at the nodes of a lattice.

    Parameters
    ----------
    surface : Surface
        The ground.
    bounds : tuple of float
        West, south, east and north of the outermost nodes (m).
    size : int
        Number of nodes along a side, of `SIZES`.
    limits : tuple of float, optional
        Lowest and highest height (m), where several fields have to have equal steps, as neighbours in one
        scene; by default those of this field.
    road : RoadMask, optional
        Gives the cells beyond the survey, where nodes have no height; None if all are covered.

    Raises
    ------
    TaskError
        If the size is none of `SIZES`, if no node has a height, or if one is not within the limits.
    """
    if size not in {s for family in SIZES.values() for s in family}:
        sizes = ", ".join(str(s) for s in sorted({s for family in SIZES.values() for s in family}))
        raise TaskError(f"a height field of {size} nodes along a side; engines take one of {sizes}")
    west, south, east, north = bounds
    eastings, northings = np.linspace(west, east, size), np.linspace(north, south, size)
    heights = np.concatenate(
        [surface.lattice(eastings, northings[row : row + ROWS]) for row in range(0, size, ROWS)]
    )
    if road is not None:
        heights[nodes_beyond(road, eastings, northings)] = np.nan
    if np.isnan(heights).all():
        raise TaskError("the surface has no height within the bounds of the height field; choose others")
    lowest, highest = float(np.nanmin(heights)), float(np.nanmax(heights))
    low, high = limits or (lowest, highest)
    if lowest < low or highest > high:
        raise TaskError(
            f"heights from {lowest:.3f} m to {highest:.3f} m are not within the limits {low:g} m to"
            f" {high:g} m; widen the limits"
        )
    return HeightField(heights, bounds, low, high)


def encode_png(field: HeightField) -> bytes:
    """Return a field as PNG, 16-bit grey; row 0 is in the north."""
    return _png(field.values)


def encode_holes(field: HeightField) -> bytes:
    """Return the nodes without a height as PNG, 8-bit grey: `HOLE` there, 0 elsewhere; row 0 is in the north.

    Unreal Engine takes it as the layer of its landscape's visibility.
    """
    return _png(np.where(np.isnan(field.heights), HOLE, 0).astype(np.uint8))


def _png(values: NDArray[np.uint8] | NDArray[np.uint16]) -> bytes:
    encoded = io.BytesIO()
    Image.fromarray(values).save(encoded, "PNG")
    return encoded.getvalue()


def encode_r16(field: HeightField) -> bytes:
    """Return a field as numbers of 16 bits alone, little-endian; row 0 is in the north."""
    return field.values.astype("<u2").tobytes()


def encode_mujoco(field: HeightField) -> bytes:
    """Return a field as MuJoCo's binary hfield: rows and columns as int32, then float32 from 0 to 1.

    Row 0 is in the **south**, as MuJoCo's y axis is northward. MuJoCo stretches the numbers to the range from
    0 to 1, so that the lowest and highest height of the field itself count here and not its limits.
    """
    heights = field.filled[::-1]
    lowest = heights.min()
    unit = (heights - lowest) / (heights.max() - lowest or 1.0)
    encoded: bytes = np.asarray(heights.shape, "<i4").tobytes() + unit.astype("<f4").tobytes()
    return encoded


def encode_sidecar(field: HeightField, crs: str, vertical: str | None = None) -> bytes:
    """Return what a field's files do not say, as JSON: place, range, axes, and the settings of engines.

    Parameters
    ----------
    field : HeightField
        The field.
    crs : str
        CRS of its bounds.
    vertical : str, optional
        CRS of its heights, if known.
    """
    west, south, east, north = field.bounds
    rows, cols = field.heights.shape
    across, along = field.spacing_m
    span = field.high - field.low
    low, high = float(field.filled.min()), float(field.filled.max())
    unreal = {
        "unreal": {
            "scale": [100 * across, 100 * along, 100 * span / UNREAL_RANGE_M],
            # An Unreal landscape has the height of its origin at the value 32768.
            "origin_z_cm": 100 * (field.low + 32768 * field.step_m),
            "axes": "x east, y south, z up; the first node is in the north-west",
        }
    }
    return Georeference(crs, (west, south, field.low), vertical).sidecar(
        "row 0 on the northern edge, column 0 on the western edge; nodes on the edges; metres",
        bounds=list(field.bounds),
        size=[cols, rows],
        spacing_m=[across, along],
        low_m=field.low,
        high_m=field.high,
        height="low_m + value * step_m",
        step_m=field.step_m,
        precision_m=field.step_m / 2,
        nodes_without_height=int(np.isnan(field.heights).sum()),
        holes=f"{HOLE} in the mask of holes; the height of the nearest node with one in the field",
        mujoco={
            "size": [(east - west) / 2, (north - south) / 2, max(high - low, FLAT_M), FLAT_M],
            "pos": [(east - west) / 2, (north - south) / 2, low - field.low],
            "axes": "x east, y north, z up; positions are relative to origin",
        },
        **(unreal if rows in SIZES["unreal"] else {}),
    )
