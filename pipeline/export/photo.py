"""Orthophotos on exported meshes, also of runs that wrote none."""

from __future__ import annotations

import io
from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from flexroad.catalog import Tile
from flexroad.catalog.lazy import lazy
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.export.source import TileItem, layer_state
from flexroad.pipeline.run.finished import FinishedTile
from flexroad.pipeline.worker.evaluator import SourceChanged
from flexroad.pipeline.worker.texture import TileTexture, tile_texture
from flexroad.tasks.export.glb import Texture
from flexroad.tasks.meshing.aerial import Aerial

Image = lazy("PIL.Image")


def check_photos(tiles: Iterable[Tile]) -> None:
    """Check that one tile at least has an orthophoto.

    Raises
    ------
    ConfigError
        If none has.
    """
    if all(tile.layer("dop") is None for tile in tiles):
        raise ConfigError(
            "--drape needs an orthophoto (layer dop), and no exported tile has one; leave out --drape"
        )


def photographed(tile: FinishedTile) -> TileItem:
    """Return a finished tile whose files have its photo."""
    return TileItem(tile, f"{tile.fingerprint} {layer_state(tile.tile, 'dop')}")


def texture_of(tile: FinishedTile) -> TileTexture:
    """Return the photo of a tile, also if the products of its run have none.

    Raises
    ------
    ConfigError
        If a file of the photo changes while it is read.
    TaskError
        If a file of the photo is missing, broken, or not one of a photo.
    """
    pattern = tile.place.pattern
    with_photo = replace(pattern, export=pattern.export.model_copy(update={"texture": True}))
    try:
        return tile_texture(with_photo.graph(tile.tile, tile.place.checksum))
    except SourceChanged as error:
        raise ConfigError(f"{error.file} {error}") from error


def aerial_of(texture: Texture, pixel_m: float) -> Aerial:
    """Return a texture as pixels: means of its own, of which at least two fit into ``pixel_m`` (m)."""
    west, south, east, north = texture.bounds
    image = Image.open(io.BytesIO(texture.jpeg))
    dx, dy = (east - west) / image.width, (north - south) / image.height
    # Large photos would take a gigabyte as numbers.
    factor = max(1, int(pixel_m / max(dx, dy) / 2))
    colour = np.asarray(image.reduce(factor), np.float64)
    rows, columns = colour.shape[:2]
    bounds = west, north - rows * factor * dy, west + columns * factor * dx, north
    return Aerial(bounds, colour, np.ones((rows, columns)))
