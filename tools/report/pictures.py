"""The pictures of a report: maps and mesh views of its tiles, as WebP.

Meshes are drawn in a child process, because VTK ends its process if OpenGL is missing.
"""

from __future__ import annotations

import io
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from flexroad.catalog.grid import Bounds
from flexroad.catalog.storage.scratch import ScratchFolder
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.run.finished import FinishedTile
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.run.status import Track, peek_statuses, untracked
from flexroad.tasks.metrics.mesh_distance import drape
from flexroad.tasks.quality.estimate import compare
from flexroad.tasks.types import Mesh
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
)

MOST = 24
"""Largest number of tiles of which all are shown; of larger runs only the worst are shown."""
QUALITY = 80
"""Quality of the WebP pictures, which take a quarter of the bytes of PNG."""
NO_MESH = "No 3D view: no usable OpenGL library (on Debian: apt-get install libegl1)."
CHILD_START_S, CHILD_MESH_S = 60.0, 15.0
"""Time limit of the child process: a fixed part, plus a part per mesh (s)."""


def tile_pictures(
    run: Run, content: Content, first: Sequence[str] = (), track: Track = untracked
) -> list[TilePictures]:
    """Draw the exported variant of every tile, or of a large run that of the worst tiles.

    - `first`: ids of finished tiles that are drawn in any case, and come first.
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
            # For example if source files were deleted after the run; the tables do not need them.
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
    """Add the view of the mesh, if there is one, and make the pictures small."""
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
    """Run the child process; return why it failed, or an empty string."""
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
