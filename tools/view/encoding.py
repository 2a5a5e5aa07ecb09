"""Scripts of the browser viewer: one per tile, one with the index of the run, one with small pictures.

Browsers do not read data files from ``file://``, but they run scripts. Each script calls a function of
``viewer.js``: ``FLEXROAD.tile(id, {...})``, ``FLEXROAD.run({...})`` or ``FLEXROAD.pictures({...})``. Data are
JSON. Arrays are base64 of little-endian numbers; rasters and mesh are compressed by zlib.
"""

from __future__ import annotations

import base64
import io
import json
import zlib
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flexroad.catalog.grid import Grid
from flexroad.catalog.lazy import lazy
from flexroad.tasks.roads.routes import CentreLine
from flexroad.tasks.spline.stepped import SteppedSurface
from flexroad.tasks.spline.surface import NurbsSurface
from flexroad.tasks.types import Bools, Floats

Image = lazy("PIL.Image")

VERSION = 3
NAME_TILE, NAME_RUN, NAME_PICTURES = ".js", "run.js", "pictures.js"
MOST_CELLS = 256
"""Largest width and height of the rasters (cells); larger rasters are thinned."""
STEP_M = 0.001
"""Step of quantised heights (m); larger if heights span more than 65 m."""
CODES = 65534
"""Number of steps of quantised heights: 16 bits, of which 0 means no height."""
PICTURE_PX, PICTURE_QUALITY = 64, 55
"""Largest width and height of the pictures on the map, and their quality (WebP)."""
SUN = (-0.5, 0.5, 0.7)
"""Direction of the light of the pictures: east, north, up."""
ROAD_SHADE, TERRAIN_SHADE = 0.45, 0.92
"""Brightness of level ground in the pictures, from 0 to 1."""
ESTIMATE_STEP_M = 0.002
"""Step of the error estimate (m): 8 bits, up to 0.5 m; larger estimates have the last value."""


def encode_tile(
    tile_id: str,
    glb: bytes,
    grid: Grid,
    corners: Floats,
    height_source: NDArray[np.uint8],
    dsm: Floats | None = None,
    dtm: Floats | None = None,
    estimate: Floats | None = None,
    surface: NurbsSurface | None = None,
    top: Floats | None = None,
    lines: tuple[CentreLine, ...] = (),
) -> bytes:
    """Return the script of a tile. Equal inputs give equal bytes.

    Rasters are of the tile's core, ``(H, W)``. Heights are in m, NaN where unknown.

    - `glb`: the mesh, with the orthophoto, if any.
    - `corners`: longitude and latitude, ``(4, 2)``: south-west, south-east, north-west, north-east.
    - `height_source`: `tasks.quality.height_source.HeightSource` of each cell.
    - `dsm`, `dtm`, `estimate`: None if the source files cannot be read.
    - `surface`: None if it is not a NURBS surface, or has levels: the viewer then takes heights from the
      mesh.
    - `top`: height of the highest level; None without levels.
    - `lines`: road lines on the tile.
    """
    stride = max(1, -(-max(grid.shape) // MOST_CELLS))
    thinned = slice(stride // 2, None, stride)
    height_source = height_source[thinned, thinned]
    dsm, dtm, estimate, top = (
        None if values is None else values[thinned, thinned] for values in (dsm, dtm, estimate, top)
    )
    rows, cols = height_source.shape
    shift = (stride // 2 + 0.5 - stride / 2) * grid.cell
    west, north = grid.west + shift, grid.north - shift
    content = {
        "glb": _packed(glb),
        "grid": {
            "west": west,
            "north": north,
            "cell": stride * grid.cell,
            "rows": rows,
            "cols": cols,
        },
        "corners": np.round(corners, 8).tolist(),
        "support": _packed(height_source.tobytes()),
        "dsm": _heights(dsm),
        "dtm": _heights(dtm),
        "estimate": _estimate(estimate),
        "surface": _surface(surface),
        "steps": _steps(surface),
        "lines": [_line(line, grid) for line in lines],
    }
    if top is not None:
        content["top"] = _heights(top)
    return _call("tile", tile_id, content)


def encode_run(content: Mapping[str, Any]) -> bytes:
    """Return the script with the index of a run, from JSON values; NaN becomes null."""
    return _call("run", _finite(content))


def picture(height: Floats, road: Bools, cell: float) -> bytes:
    """Return a tile seen from above as a small grey WebP image: hillshade, roads darker.

    - `height`: the surface (m); NaN beyond the survey, where the picture is transparent.
    """
    by_south, by_east = np.gradient(height, cell) if min(height.shape) > 1 else np.zeros((2, *height.shape))
    east, north, up = np.array(SUN) / np.linalg.norm(SUN)
    light = (-by_east * east + by_south * north + up) / np.sqrt(1 + by_east**2 + by_south**2)
    shade = np.where(road, ROAD_SHADE, TERRAIN_SHADE) * (1 + 1.5 * (light - up))
    unknown = np.isnan(shade)
    image = Image.fromarray((255 * np.clip(np.where(unknown, 0, shade), 0, 1)).astype(np.uint8))
    if unknown.any():
        image.putalpha(Image.fromarray(np.where(unknown, 0, 255).astype(np.uint8)))
    image.thumbnail((PICTURE_PX, PICTURE_PX), Image.Resampling.BOX)
    encoded = io.BytesIO()
    image.save(encoded, "WEBP", quality=PICTURE_QUALITY)
    return encoded.getvalue()


def encode_pictures(pictures: Mapping[str, str]) -> bytes:
    """Return the script with the pictures of tiles, by id, as base64."""
    return _call("pictures", pictures)


def _call(function: str, *arguments: Any) -> bytes:
    texts = (json.dumps(argument, separators=(",", ":"), allow_nan=False) for argument in arguments)
    return f"FLEXROAD.{function}({','.join(texts)});\n".encode("ascii")


def _finite(value: Any) -> Any:
    """Return JSON values with None instead of numbers that are not finite."""
    if isinstance(value, Mapping):
        return {key: _finite(part) for key, part in value.items()}
    if isinstance(value, Sequence) and not isinstance(value, str):
        return [_finite(part) for part in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value


def _packed(data: bytes) -> str:
    return base64.b64encode(zlib.compress(data, 6)).decode("ascii")


def _heights(values: Floats | None) -> dict[str, Any] | None:
    if values is None or not (known := np.isfinite(values)).any():
        return None
    low, high = float(values[known].min()), float(values[known].max())
    step = max(STEP_M, (high - low) / CODES)
    codes = np.zeros(values.shape, "<u2")
    codes[known] = np.minimum(np.round((values[known] - low) / step), CODES).astype("<u2") + 1
    return {"low": low, "step": step, "data": _packed(codes.tobytes())}


def _estimate(values: Floats | None) -> str | None:
    if values is None:
        return None
    known = np.isfinite(values)
    codes = np.zeros(values.shape, np.uint8)
    codes[known] = np.minimum(np.round(values[known] / ESTIMATE_STEP_M), 254).astype(np.uint8) + 1
    return _packed(codes.tobytes())


def _surface(surface: NurbsSurface | None) -> dict[str, Any] | None:
    if surface is None:
        return None
    weighted = bool((surface.W != 1).any())
    return {
        "degree": list(surface.degree),
        "bounds": [float(edge) for edge in surface.bounds],
        "datum": float(surface.datum),
        "knots_u": _doubles(surface.knots_u),
        "knots_v": _doubles(surface.knots_v),
        "A": _doubles(surface.A),
        "W": _doubles(surface.W) if weighted else None,
    }


def _steps(surface: NurbsSurface | None) -> dict[str, Any] | None:
    """Return the cells with steps, and the steps; these cells are not thinned."""
    if not isinstance(surface, SteppedSurface):
        return None
    steps = _heights(np.where(surface.steps == 0, np.nan, surface.steps))
    if steps is None:
        return None
    cells = surface.cells
    west, _, _, north = cells.exact_bounds
    grid = {"west": west, "north": north, "cell": cells.cell, "rows": cells.height, "cols": cells.width}
    return {"grid": grid, **steps}


def _doubles(values: Floats) -> str:
    return base64.b64encode(np.ascontiguousarray(values, "<f8").tobytes()).decode("ascii")


def _line(line: CentreLine, grid: Grid) -> dict[str, Any]:
    """Return a line with points relative to the tile's south-west corner, in centimetres."""
    places = np.round(line.points - (grid.west, grid.south), 2)
    return {"name": line.name, "points": places.ravel().tolist()}
