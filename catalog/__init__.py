"""What exists: tiles, where they lie, and where their layers are."""

from flexroad.catalog.errors import CatalogError
from flexroad.catalog.grid import Bounds, Grid
from flexroad.catalog.index import Catalog
from flexroad.catalog.tile import LAYERS, Layer, Tile

__all__ = ["LAYERS", "Bounds", "Catalog", "CatalogError", "Grid", "Layer", "Tile"]
