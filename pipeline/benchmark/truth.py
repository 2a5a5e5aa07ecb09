"""The second catalog of synthetic data: the same layers, with the true heights and roads as reference."""

from __future__ import annotations

from dataclasses import replace

from flexroad.catalog import Layer, Tile

KNOWN = "known"
"""Folder of the true layers."""
CATALOG = "catalog_true.parquet"
LAYERS = ("reference", "reference_road")


def with_truth(tile: Tile, folder: str, dataset: str) -> Tile:
    """Return the tile with the truth as reference.

    Parameters
    ----------
    tile : Tile
        A tile with a reference of its own.
    folder : str
        Folder of the true layers, relative to the tile's root.
    dataset : str
        Name of the data in reports.
    """
    layers = tuple(
        Layer(layer.name, (f"{folder}/{layer.name}/{tile.id}.tif",)) if layer.name in LAYERS else layer
        for layer in tile.layers
    )
    return replace(tile, layers=layers, dataset=dataset)
