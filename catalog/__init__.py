"""The catalog of tiles: their ids, grids and the files of their layers."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from flexroad.catalog.errors import CatalogError
    from flexroad.catalog.grid import Bounds, Grid
    from flexroad.catalog.index import Catalog
    from flexroad.catalog.tile import LAYERS, Layer, Tile

__all__ = ["LAYERS", "Bounds", "Catalog", "CatalogError", "Grid", "Layer", "Tile"]

_HOMES = {"CatalogError": "errors", "Bounds": "grid", "Grid": "grid", "Catalog": "index"}


def __getattr__(name: str) -> Any:
    """Import a public name on first use, so that commands without a catalog start fast."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"flexroad.catalog.{_HOMES.get(name, 'tile')}"), name)
