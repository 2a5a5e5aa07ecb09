"""3D Tiles of a run: its GLB files unchanged, and tilesets that place them on the Earth."""

from __future__ import annotations

import json
import math
from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from flexroad.catalog.ellipsoidal import Datum, Ellipsoidal
from flexroad.catalog.ids import safe_name
from flexroad.catalog.storage.paths import Location, exists, parse_location, read, write
from flexroad.pipeline.execute import Executor
from flexroad.pipeline.export.options import Options
from flexroad.pipeline.export.pieces import Piece, write_pieces
from flexroad.pipeline.export.source import FinishedTile, Source
from flexroad.pipeline.store.products import TileProducts
from flexroad.pipeline.worker.exports import GLB, file_name
from flexroad.tasks.export import glb, tiles3d
from flexroad.tasks.types import Mesh

VERSION = tiles3d.VERSION
BLOCK_M = 4000.0
"""Side of the area of one nested tileset (m)."""
BLOCK_ERROR_M, LEAF_ERROR_M = 64.0, 0.05
"""Geometric errors (m): a block shows nothing without its tiles, which are loaded from some km on."""


@dataclass(frozen=True)
class Place:
    """What the place of a tile's mesh is computed of."""

    run: str
    crs: str
    origin: tuple[float, float]
    datum: Datum


def write_tilesets(
    source: Source, tiles: Iterable[FinishedTile], folder: Location, options: Options, executor: Executor
) -> None:
    """Write the GLB file of each tile and tilesets over them: one per block of 4 km, one over the blocks."""
    assert options.datum is not None  # the command checks it
    place = Place(str(source.run.path), source.crs, source.origin, options.datum)
    blocks: defaultdict[tuple[int, int], list[dict[str, Any]]] = defaultdict(list)
    for row in write_pieces(tiles, folder, VERSION, piece, place, executor):
        blocks[tuple(row["block"])].append(row["leaf"])
    children = []
    for (column, line), leaves in sorted(blocks.items()):
        name = f"blocks/{column}_{line}.json"
        leaves.sort(key=lambda leaf: str(leaf["content"]["uri"]))
        block = tiles3d.tileset(leaves, BLOCK_ERROR_M)
        write(folder / name, _encoded(block))
        children.append(
            {
                "boundingVolume": block["root"]["boundingVolume"],
                "geometricError": BLOCK_ERROR_M,
                "content": {"uri": name},
            }
        )
    extras = {"crs": source.crs, "datum": options.datum.text}
    write(folder / "tileset.json", _encoded(tiles3d.tileset(children, 2 * BLOCK_ERROR_M, **extras)))


def piece(tile: FinishedTile, place: Place) -> Piece:
    """Return the GLB file of a tile, and its entry in the tileset of its block."""
    mesh, grid = tile.mesh, tile.tile.grid
    heights = mesh.vertices[:, 2] + mesh.origin[2]
    name = f"tiles/{safe_name(tile.id)}{glb.NAME}"
    placed = tiles3d.placed(
        f"../{name}",
        grid.bounds,
        (float(heights.min()), float(heights.max())),
        place.origin,
        Ellipsoidal(place.crs, place.datum),
    )
    block = math.floor(grid.west / BLOCK_M), math.floor(grid.south / BLOCK_M)
    return Piece(
        {name: _glb(tile, mesh, place)}, {"block": block, "leaf": tiles3d.leaf(placed, LEAF_ERROR_M)}
    )


def _glb(tile: FinishedTile, mesh: Mesh, place: Place) -> bytes:
    """Return the GLB file of the run, or a new one if the run writes none."""
    file = TileProducts.of(parse_location(place.run), tile.id).path / file_name(tile.id, tile.variant, GLB)
    return read(file) if exists(file) else glb.encode(mesh, (*place.origin, 0.0))


def _encoded(content: dict[str, Any]) -> bytes:
    return json.dumps(content, separators=(",", ":"), allow_nan=False).encode()
