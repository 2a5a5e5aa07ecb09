"""The vertical CRS of a tile's heights, as its files declare it."""

from __future__ import annotations

from flexroad.catalog import Tile
from flexroad.catalog.crs import vertical
from flexroad.catalog.guard.open_raster import kept_raster
from flexroad.catalog.scan.rasters import quiet
from flexroad.tasks.io.raster import Unreadable, read_raster
from flexroad.tasks.io.raster_header import header

LAYERS = ("dsm", "dtm")
"""Layers that the surface's heights come from."""


def vertical_crs(tile: Tile) -> str | None:
    """Return the vertical CRS of the heights that `load` gives, in metres; None if it is not known.

    It is known if all files of DSM and DTM on the tile declare the same one; only their headers are read.
    Files that cannot be read are left out, as by `load`.
    """
    found: set[str | None] = set()
    tile = tile.within(tile.grid.bounds)
    with quiet():
        for layer in (layer for layer in tile.layers if layer.name in LAYERS):
            for path in tile.paths(layer):
                try:
                    file = read_raster(path, layer.name, header, kept_raster, tile.missing)
                except Unreadable:
                    continue
                declared = file.crs or layer.crs
                found.add(vertical(declared) if declared else None)
    return found.pop() if len(found) == 1 else None
