"""The orthophoto of a synthetic scene: its ground, houses, trees and cars, coloured and lit.

It is simplified, for segmentation and for viewing: colours follow the `Kind` of a cell, the sun is in the
south-east, and shadow lengths follow from heights. Lines are painted along the middle of wide roads; they are
derived from the true road cells, not from the street plan.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from flexroad.catalog.grid import Grid
from flexroad.tasks.errors import TaskError
from flexroad.tasks.types import Bools, Floats
from flexroad.tools.synthetic.scene import Scene, make_scene
from flexroad.tools.synthetic.spoilers import Kind
from flexroad.tools.synthetic.world import DEFAULTS, SceneOptions, generator, waves

Picture = NDArray[np.float32]
"""``(H, W, 3)``, red, green and blue, 0 to 255."""

MARGIN_M = 24.0
"""Margin around the tile (m), so that shadows and road edges beyond its border are included."""
SUN_AZIMUTH_DEG, SUN_HEIGHT_DEG = 145.0, 48.0
SHADE = np.array([0.42, 0.46, 0.56], np.float32)
"""Fraction of red, green and blue in a shadow: only the blue sky lights it."""
SENSOR_NOISE = 2.5
"""Standard deviation of the noise, on the scale 0 to 255."""
PAVEMENT_M = 2.5
"""Width of the pavement beside an urban or suburban road (m)."""
DASH_M = 3.0
"""Length of a painted dash and of the gap after it (m)."""
LINE_M = 0.25
"""Width of painted lines (m)."""
STEP = 1.2
"""Slope that separates adjacent roofs."""

ASPHALT, CONCRETE, FLAGSTONES, PAINT = (104, 105, 108), (142, 139, 133), (156, 151, 144), (232, 232, 226)
LAWN, DRY, YARD, LEAVES = (98, 122, 66), (146, 142, 98), (148, 140, 128), (62, 92, 46)
CROPS = np.array([(112, 138, 66), (172, 156, 104), (134, 112, 84), (90, 126, 60), (158, 150, 88)])
ROOFS = np.array(
    [(150, 84, 66), (128, 72, 60), (92, 88, 88), (120, 116, 112), (168, 164, 158), (104, 84, 70)]
)
PAINTS = np.array(
    [(210, 210, 212), (44, 46, 50), (120, 124, 130), (142, 36, 36), (48, 66, 110), (230, 228, 224)]
)
UNIFORM = {
    Kind.DECK: (CONCRETE, 0.6),
    Kind.PAVED: ((114, 114, 116), 0.9),
    Kind.FIELD: ((150, 138, 120), 0.9),
    Kind.PLANTS: ((84, 108, 56), 0.45),
    Kind.RAIL: ((172, 174, 178), 0.8),
    Kind.WIRE: ((66, 66, 70), 0.5),
}
"""Kinds of uniform colour: the colour, and its opacity over the ground."""
PARCEL_M = 60.0
"""Width of a field (m); its length is twice that."""


def orthophoto(
    grid: Grid,
    seed: int,
    stratum: str | None = None,
    options: SceneOptions = DEFAULTS,
    gsd: float = 0.5,
) -> NDArray[np.uint8]:
    """Return the orthophoto of the scene that `make_scene` gives for the same arguments.

    - result: red, green and blue, 0 to 255, over the grid's bounds.
    """
    pixels = _pixel_grid(grid, gsd)
    # A photo has no height noise and no voids.
    noise_free = options.model_copy(update={"dsm_noise_m": (0.0, 0.0), "mixed": 0.0, "voids": 0.0})
    scene = make_scene(pixels.buffered(MARGIN_M), seed, stratum, noise_free)
    rng = generator(seed, "orthophoto", *map(int, grid.origin))
    picture = _ground(scene, seed)
    _paint(picture, _lines(scene), PAINT, min(LINE_M / gsd, 0.9))
    _paint_objects(picture, scene, seed)
    picture *= _light(scene.dsm, gsd)[..., None]
    shadow = ndimage.gaussian_filter(_shadow(scene.dsm, gsd).astype(np.float32), 0.6)[..., None]
    picture *= 1 - shadow * (1 - SHADE)
    # The lens blurs the image; the sensor adds noise.
    image = ndimage.gaussian_filter(picture, (0.5, 0.5, 0))
    image = image[scene.grid.window(pixels)]
    image += rng.normal(0, SENSOR_NOISE, image.shape).astype(np.float32)
    bands: NDArray[np.uint8] = np.clip(np.round(image), 0, 255).astype(np.uint8).transpose(2, 0, 1)
    return bands


def _pixel_grid(grid: Grid, gsd: float) -> Grid:
    pixels = Grid.covering(grid.crs, grid.bounds, gsd) if gsd > 0 else None
    if pixels is None or not np.allclose(pixels.bounds, grid.bounds, rtol=0, atol=1e-6):
        raise TaskError(
            f"a GSD of {gsd:g} m does not divide the tile {grid.bounds}; use one that does, like 0.5"
        )
    return pixels


def _ground(scene: Scene, seed: int) -> Picture:
    """Return the colours of the ground without objects."""
    x, y = np.meshgrid(scene.grid.eastings, scene.grid.northings)
    patchy = waves(generator(seed, "green"), np.geomspace(9, 90, 9), 1 / 3)(x, y)
    dry = np.clip(0.3 + 0.5 * patchy, 0, 1).astype(np.float32)[..., None]
    picture: Picture = np.array(LAWN, np.float32) * (1 - dry) + np.array(DRY, np.float32) * dry
    away = ndimage.distance_transform_edt(~scene.reference_road) * scene.grid.cell
    if scene.stratum == "rural":
        _paint(picture, away > 2 * PAVEMENT_M, _fields(x, y, seed), 0.8)
    else:
        yards = waves(generator(seed, "yards"), np.geomspace(7, 40, 7), 1 / 3)(x, y)
        _paint(picture, yards > (0.1 if scene.stratum == "urban" else 0.8), YARD, 0.85)
        _paint(picture, away <= PAVEMENT_M, FLAGSTONES, 0.9)
    wear = waves(generator(seed, "worn"), np.geomspace(2, 40, 12), 1.8)(x, y)
    _paint(picture, scene.reference_road, ASPHALT, 1.0)
    picture += wear[..., None]
    return picture


def _fields(x: Floats, y: Floats, seed: int) -> Picture:
    """Return the colours of a patchwork of fields with furrows."""
    turn = generator(seed, "fields").uniform(0, np.pi)
    u, v = np.cos(turn) * x + np.sin(turn) * y, np.cos(turn) * y - np.sin(turn) * x
    column, row = np.floor(u / PARCEL_M).astype(np.int64), np.floor(v / (2 * PARCEL_M)).astype(np.int64)
    crop = CROPS[_draw(column, row, seed, len(CROPS))].astype(np.float32)
    furrows: Picture = crop + 4 * np.sin(2 * np.pi * u / 3.0)[..., None].astype(np.float32)
    return furrows


def _paint_objects(picture: Picture, scene: Scene, seed: int) -> None:
    """Paint the objects on the ground, in place."""
    kind, grid = scene.kind, scene.grid
    for uniform, (colour, opacity) in UNIFORM.items():
        _paint(picture, kind == uniform, colour, opacity)
    roofs = _label_roofs(kind == Kind.BUILDING, scene.dsm, grid.cell)
    _paint(picture, roofs > 0, _object_colours(roofs, grid, seed, ROOFS), 1.0)
    cars, _ = ndimage.label(np.isin(kind, (Kind.PARKED_CAR, Kind.MOVING_CAR)))
    _paint(picture, cars > 0, _object_colours(cars, grid, seed, PAINTS), 1.0)
    x, y = np.meshgrid(grid.eastings, grid.northings)
    tone = 14 * waves(generator(seed, "leaves"), np.geomspace(4, 25, 6), 0.4)(x, y)
    leaves = np.array(LEAVES, np.float32) + tone[..., None].astype(np.float32)
    _paint(picture, kind == Kind.CROWN, leaves, 1.0)


def _label_roofs(built: Bools, dsm: Floats, cell: float) -> NDArray[np.int32]:
    """Return the number of the roof in each cell, ``(H, W)``; adjacent roofs are split at height steps."""
    rise = np.maximum(np.abs(ndimage.sobel(dsm, 0)), np.abs(ndimage.sobel(dsm, 1))) / (8 * cell)
    inner, _ = ndimage.label(built & (rise < STEP))
    # Cells at a step belong to the nearest roof.
    nearest = ndimage.distance_transform_edt(inner == 0, return_distances=False, return_indices=True)
    numbers: NDArray[np.int32] = np.where(built, inner[tuple(nearest)], 0).astype(np.int32)
    return numbers


def _object_colours(numbers: NDArray[np.int32], grid: Grid, seed: int, palette: NDArray[Any]) -> Picture:
    """Return a random colour for each labelled object, drawn from the location of its first cell."""
    _, first = np.unique(numbers, return_index=True)
    row, col = np.unravel_index(first, numbers.shape)
    east = np.round(grid.eastings[col] / grid.cell).astype(np.int64)
    north = np.round(grid.northings[row] / grid.cell).astype(np.int64)
    drawn = palette[_draw(east, north, seed, len(palette))].astype(np.float32)
    lookup = np.zeros((int(numbers.max()) + 1, 3), np.float32)
    lookup[numbers.ravel()[first]] = drawn
    return lookup[numbers]


def _draw(i: NDArray[np.int64], j: NDArray[np.int64], seed: int, n: int) -> NDArray[np.intp]:
    """Return a pseudo-random number below ``n`` for each pair, the same in every tile (a hash)."""
    mixed = i.astype(np.uint64) * np.uint64(0x9E3779B97F4A7C15) + j.astype(np.uint64) + np.uint64(seed)
    mixed = (mixed ^ (mixed >> np.uint64(31))) * np.uint64(0xBF58476D1CE4E5B9)
    return ((mixed >> np.uint64(40)) % np.uint64(n)).astype(np.intp)


def _lines(scene: Scene) -> Bools:
    """Return the dashed centre markings of roads with two or more lanes, ``(H, W)``.

    The middle of a road is the ridge of the distance to its edge. At crossings, where ridges of several
    directions meet, there are no markings.
    """
    grid = scene.grid
    inside = ndimage.distance_transform_edt(scene.reference_road) * grid.cell
    rise_y, rise_x = (ndimage.gaussian_filter(inside, 1, order=o) / grid.cell for o in ((1, 0), (0, 1)))
    ridge = (np.hypot(rise_x, rise_y) < 0.4) & (inside > 2.5)
    # Rows count southwards, so the sign of y changes. Squared, so that opposite directions are equal.
    across = (rise_x - 1j * rise_y) ** 2
    reach = 3.0 / grid.cell
    real, imaginary, total = (
        ndimage.gaussian_filter(part, reach) for part in (across.real, across.imag, np.abs(across))
    )
    single = np.hypot(real, imaginary) > 0.8 * total
    # Only eight directions, so that the dashes of neighbouring cells are aligned.
    heading = np.round(np.arctan2(imaginary, real) / 2 / (np.pi / 8)) * (np.pi / 8) + np.pi / 2
    x, y = np.meshgrid(grid.eastings, grid.northings)
    along = np.cos(heading) * x + np.sin(heading) * y
    lines: Bools = ridge & single & (along % (2 * DASH_M) < DASH_M)
    return lines


def _light(dsm: Floats, cell: float) -> Picture:
    """Return the brightness of each cell from its slope, 1 for level ground, ``(H, W)``."""
    south, east = np.gradient(dsm, cell)
    sun = np.array(_sun())
    # The normal of z(x, y) is (-dz/dx, -dz/dy, 1); slopes are halved, or all roof edges would be black.
    normal = -0.5 * east * sun[0] + 0.5 * south * sun[1] + sun[2]
    cosine = normal / np.sqrt(1 + 0.25 * (east**2 + south**2))
    light: Picture = np.clip(0.35 + 0.65 * cosine / sun[2], 0.35, 1.35).astype(np.float32)
    return light


def _shadow(dsm: Floats, cell: float) -> Bools:
    """Return the cells in the shadow of higher cells, ``(H, W)``."""
    east, north, up = _sun()
    level = np.hypot(east, north)
    shaded = np.zeros(dsm.shape, bool)
    for k in range(1, int(MARGIN_M / cell)):
        # Cells from the opposite side change only the margin.
        shifted = np.roll(dsm, (round(k * north / level), -round(k * east / level)), (0, 1))
        shaded |= shifted - k * cell * up / level > dsm + 0.3
    return shaded


def _sun() -> tuple[float, float, float]:
    """Return the unit vector to the sun: east, north, up."""
    azimuth, height = np.radians(SUN_AZIMUTH_DEG), np.radians(SUN_HEIGHT_DEG)
    return np.sin(azimuth) * np.cos(height), np.cos(azimuth) * np.cos(height), np.sin(height)


def _paint(picture: Picture, cells: Bools, colour: Any, opacity: float) -> None:
    """Paint cells in place, with one colour or a colour per cell."""
    colours = np.broadcast_to(np.asarray(colour, np.float32), picture.shape)
    picture[cells] = (1 - opacity) * picture[cells] + opacity * colours[cells]
