"""The pictures of a report as WebP: maps and mesh views of its tiles, and the relief of all tiles.

Meshes are drawn in a child process, because VTK ends its process if OpenGL is missing.
"""

from __future__ import annotations

import io
import math
import subprocess
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from flexroad.catalog import Tile
from flexroad.catalog.grid import Bounds
from flexroad.catalog.storage.scratch import ScratchFolder
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.run.finished import FinishedTile, RunPlace
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.run.status import Track, peek_statuses, untracked
from flexroad.tasks.metrics.mesh_distance import drape
from flexroad.tasks.quality.estimate import compare
from flexroad.tasks.types import Floats, Mesh, RoadMask, Surface
from flexroad.tools.report.content import WORST_ESTIMATES, WORST_ROADS, Content
from flexroad.tools.report.pages import TilePictures
from flexroad.tools.report.render import (
    _small,
    error_map,
    estimate_picture,
    filter_picture,
    height_source_picture,
    hillshade,
    log,
    sunlight,
)
from flexroad.tools.report.steps import Results

MOST = 24
"""Largest number of tiles that are all shown; from larger runs only the worst are shown."""
QUALITY, RELIEF_QUALITY = 80, 62
"""Quality of the WebP pictures (a quarter of the bytes of PNG) and of the relief."""
NO_MESH = "No 3D view: no usable OpenGL library (on Debian: apt-get install libegl1)."
CHILD_START_S, CHILD_MESH_S = 60.0, 15.0
"""Time limit of the child process: a fixed part, plus a part per mesh (s)."""
PIXELS = 2_000_000
"""Pixels of the relief of all tiles."""
SIDE_PX = (6, 320)
"""Smallest and largest side of the part of one tile in it."""
EXAGGERATION = 2.0
"""Factor of the slopes; terrain without buildings is flat."""
LEVEL, ROAD = 226, 92
"""Grey of level ground and of roads."""
OPACITY = 0.78
"""Opacity of roads over the relief."""


def tile_pictures(
    run: Run, content: Content, first: Sequence[str] = (), track: Track = untracked
) -> list[TilePictures]:
    """Draw the exported variant of every tile; in a large run only of the worst tiles.

    - `first`: ids of finished tiles that are always drawn, and come first.
    """
    variant = run.config.export.variants[0]
    tile_ids = list(dict.fromkeys([*first, *_shown(content)]))
    maps: dict[str, TilePictures] = {}
    meshes: dict[str, Mesh] = {}
    tiles = {tile.id: tile for tile in run.catalog.tiles}
    statuses = peek_statuses(run, [tiles[tile_id] for tile_id in tile_ids if tile_id in tiles])
    for status in track(statuses, "drawing tiles", len(tile_ids)):
        tile = FinishedTile.of(run, status, variant)
        try:
            meshes[tile.id] = tile.mesh
            maps[tile.id] = _maps(tile)
        except ConfigError as error:
            # For example if source files were deleted after the run. The tables do not need them.
            reason = str(error).removeprefix(f"{tile.label}: ")
            maps[tile.id] = TilePictures(tile.id, (), (f"No pictures: {reason}",))
    views = render_meshes(meshes)
    return [_finished(pictures, views.get(tile_id)) for tile_id, pictures in maps.items()]


def _shown(content: Content) -> list[str]:
    if len(content.tiles) <= MOST:
        return list(content.tiles)
    return list(
        dict.fromkeys(
            name for title in (WORST_ESTIMATES, WORST_ROADS) for name in content.tables[title][0]["tile"]
        )
    )


def webp(picture: bytes, width_px: int | None = None) -> bytes:
    """Return a picture as WebP, smaller if it is wider than ``width_px``."""
    image = Image.open(io.BytesIO(picture)).convert("RGB")
    if width_px is not None and image.width > width_px:
        image = image.resize(
            (width_px, round(image.height * width_px / image.width)), Image.Resampling.LANCZOS
        )
    buffer = io.BytesIO()
    image.save(buffer, "webp", quality=QUALITY, method=6)
    return buffer.getvalue()


def _maps(tile: FinishedTile) -> TilePictures:
    data, road, clusters, mesh, quality = tile.data, tile.road, tile.clusters, tile.mesh, tile.quality
    core, window = data.core, data.grid.window(data.core)
    dsm, raw, kept = data.dsm[window], road.mask[window], clusters.mask[window]
    truth = (data.dtm if data.reference is None else data.reference)[window]
    against = "DTM" if data.reference is None else "reference"
    cells = compare(data, road, clusters, tile.surface, tile.assessment.dsm_dtm_tolerance_m)
    at = tile.flag_places
    return TilePictures(
        tile.id,
        (
            ("Error estimate along the road", estimate_picture(dsm, cells.estimate, raw, core, at)),
            ("DSM", hillshade(dsm, core)),
            ("Road mask: before and after the filter", filter_picture(dsm, raw, kept, core)),
            (
                "Height source of the surface along the road",
                height_source_picture(dsm, quality.height_source, raw, core),
            ),
            (
                f"{tile.variant} minus {against}",
                error_map(drape(mesh, core) + mesh.origin[2] - truth, core, road=raw),
            ),
        ),
        (*data.notes, *road.notes),
        at,
    )


def _finished(tile: TilePictures, view: bytes | None) -> TilePictures:
    """Add the view of the mesh, if any, and reduce the pictures."""
    if not tile.pictures:
        return tile
    views, notes = ((("The mesh of the road", view),), ()) if view else ((), (NO_MESH,))
    pictures = tuple((caption, webp(png)) for caption, png in (*tile.pictures, *views))
    return replace(tile, pictures=pictures, notes=(*tile.notes, *notes))


def render_meshes(
    meshes: Mapping[str, Mesh],
    colours: Mapping[str, NDArray[np.uint8]] | None = None,
    within: Bounds | None = None,
    size_px: tuple[int, int] | None = None,
) -> dict[str, bytes | None]:
    """Draw oblique views of meshes from the south, all in one child process.

    - `colours`: red, green and blue at the vertices of each mesh, ``(V, 3)``; by default road and terrain
      have one colour each.
    - `within`: the part to draw (m, in the meshes' CRS); by default the complete mesh.
    - result: a PNG by name, or None if it could not be drawn; the reason is logged as a warning. Heights are
      exaggerated by the factor given in the picture.
    """
    if not meshes:
        return {}
    with ScratchFolder() as name:
        folder = Path(name)
        for i, (mesh_name, mesh) in enumerate(meshes.items()):
            optional = {
                "colours": None if colours is None else colours[mesh_name],
                "within": None if within is None else np.subtract(within, mesh.origin[:2] * 2),
                "size_px": size_px,
            }
            given: dict[str, Any] = {key: value for key, value in optional.items() if value is not None}
            np.savez(folder / f"{i}.npz", vertices=mesh.vertices, faces=mesh.faces, road=mesh.road, **given)
        reason = _draw_in_child(folder, CHILD_START_S + CHILD_MESH_S * len(meshes))
        files = [folder / f"{i}.png" for i in range(len(meshes))]
        pictures = [_small(Image.open(file)) if file.exists() else None for file in files]
    by_name = dict(zip(meshes, pictures, strict=True))
    missing = [name for name, picture in by_name.items() if picture is None]
    if missing:
        log.warning("no mesh pictures of %s: %s", ", ".join(missing), reason)
    return by_name


def _draw_in_child(folder: Path, seconds: float) -> str:
    """Run the child process; return the reason of a failure, or an empty string."""
    # Started by file, not by module: the child does not import flexroad and starts in half the time. With -P
    # the modules of this folder (steps, pages) cannot shadow others.
    command = [sys.executable, "-P", str(Path(__file__).with_name("mesh_view.py")), str(folder)]
    try:
        child = subprocess.run(command, capture_output=True, text=True, timeout=seconds, check=False)
    except subprocess.TimeoutExpired:
        return f"not finished after {seconds:.0f} s"
    if child.returncode < 0:
        return f"VTK ended with signal {-child.returncode}; is OpenGL (libegl1 or libosmesa6) installed?"
    lines = child.stderr.strip().splitlines()
    return lines[-1] if child.returncode and lines else ""


@dataclass(frozen=True)
class _Relief:
    """The background of the map: one picture with a square of equal size for each tile."""

    webp: bytes
    side_px: int
    """Side of the square of a tile."""
    columns: int
    """Squares in a row of the picture."""
    places: dict[str, int]
    """Number of the square of each tile by id, row by row from the top left."""


def relief(run: Run, tiles: Iterable[Tile], results: Results, track: Track = untracked) -> _Relief | None:
    """Draw the surfaces of tiles as a shaded relief with their roads; None if the store has no surface.

    - `tiles`: the tiles to draw; tiles whose surface is not in the store are left out.
    """
    tiles = list(tiles)
    if not tiles:
        return None
    side = min(max(math.isqrt(PIXELS // len(tiles)), SIDE_PX[0]), SIDE_PX[1])
    columns = math.isqrt(len(tiles) - 1) + 1
    picture = np.zeros((side * math.ceil(len(tiles) / columns), side * columns, 2), np.uint8)
    place, stored = RunPlace.of(run), results.get(run.config.export.variants[0], {})
    places: dict[str, int] = {}
    for tile in track(tiles, "drawing the map", len(tiles)):
        if tile.id not in stored or not (found := place.stored(*stored[tile.id])):
            continue
        row, column = divmod(len(places), columns)
        square = picture[row * side : (row + 1) * side, column * side : (column + 1) * side]
        square[:] = _square(*found, side)
        places[tile.id] = len(places)
    if not places:
        return None
    buffer = io.BytesIO()
    Image.fromarray(picture, "LA").convert("RGBA").save(buffer, "webp", quality=RELIEF_QUALITY, method=4)
    return _Relief(buffer.getvalue(), side, columns, places)


def _square(surface: Surface, road: RoadMask, side: int) -> NDArray[np.uint8]:
    """Return grey and opacity of one tile, ``(side, side, 2)``; pixels are not square if the tile is not."""
    grid = road.core
    step_x, step_y = grid.width * grid.cell / side, grid.height * grid.cell / side
    # One pixel beyond each edge, so that the shading continues across tiles.
    beyond: Floats = np.arange(-1.0, side + 1.0) + 0.5
    east: Floats = np.asarray(grid.west + beyond * step_x)
    north: Floats = np.asarray(grid.north - beyond * step_y)
    height = surface.lattice(east, north)
    to_south, to_east = np.gradient(EXAGGERATION * height, step_y, step_x)
    light = sunlight(np.asarray(to_east), np.asarray(to_south))
    grey = np.clip(LEVEL * light, 0.35 * LEVEL, 255.0)[1:-1, 1:-1]
    share, outside = (_resampled(cells, road, side) for cells in (road.mask, road.outside))
    grey = grey + OPACITY * share * (ROAD - grey)
    visible = np.isfinite(grey) & (outside < 0.5)
    return np.dstack([np.where(visible, np.nan_to_num(grey), LEVEL), 255 * visible]).astype(np.uint8)


def _resampled(cells: NDArray[np.bool_], road: RoadMask, side: int) -> Floats:
    """Return the share of True cells in each pixel."""
    core = np.ascontiguousarray(cells[road.grid.window(road.core)], np.float32)
    return np.asarray(cv2.resize(core, (side, side), interpolation=cv2.INTER_AREA), np.float64)
