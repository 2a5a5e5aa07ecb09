"""The orthophoto of a tile as the texture of its meshes."""

from __future__ import annotations

from dataclasses import replace

from flexroad.catalog import Layer, Tile
from flexroad.pipeline.graph.graph import TileGraph
from flexroad.pipeline.worker.evaluator import check_unchanged
from flexroad.tasks.errors import LayerMissing
from flexroad.tasks.io.orthophoto import read_photo
from flexroad.tasks.load import layer_source
from flexroad.tasks.products import glb
from flexroad.tasks.types import Orthophoto

NO_PHOTO = "dop: no orthophoto on the tile; its GLB has no texture"

QUALITY = 85
"""Quality of the texture's JPEG (percent): blocks are hardly visible."""


def tile_texture(graph: TileGraph) -> tuple[glb.Texture | None, str]:
    """Return the texture of a tile's meshes: its orthophoto, at its own resolution up to `export.texture_px`.

    - `texture`: none if the configuration wants none, or the tile has no photo.
    - `note`: what the photo lacks, or empty.
    """
    export, tile = graph.export, graph.tile
    if not export.texture:
        return None, ""
    if not graph.product_sources:
        return None, NO_PHOTO
    (layer,) = graph.product_sources
    try:
        photo = tile_photo(tile, layer, export.texture_px)
    finally:
        check_unchanged(graph, tile.paths(layer))
    if photo is None:
        return None, NO_PHOTO
    unknown = 1 - photo.known.mean()
    note = f"dop: {unknown:.1%} of the texture has no orthophoto and takes its mean colour" if unknown else ""
    return glb.texture(photo, QUALITY), note


def tile_photo(tile: Tile, layer: Layer, largest_px: int) -> Orthophoto | None:
    """Return the orthophoto of a tile, None if no pixel of it is known.

    - `layer`: the tile's orthophoto.
    - `largest_px`: largest width and height (pixels); a finer photo is averaged.
    """
    source = layer_source(replace(tile, layers=(layer,)), layer.name)
    assert source is not None
    west, south, east, north = tile.grid.bounds
    try:
        photo = read_photo(source, tile.grid, finest_m=max(east - west, north - south) / largest_px)
    except LayerMissing:
        return None
    return photo if photo.known.any() else None
