"""What exists: tiles, where they lie, and where their layers are."""

from catalog.errors import CatalogError
from catalog.grid import Bounds, Grid
from catalog.index import Catalog
from catalog.tile import LAYERS, Layer, Tile

__all__ = ["LAYERS", "Bounds", "Catalog", "CatalogError", "Grid", "Layer", "Tile"]
