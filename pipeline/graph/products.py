"""Versions of the products of a tile: a tile of an older version is exported again, from the store."""

from __future__ import annotations

from flexroad.pipeline.config.models import Export
from flexroad.tasks.export import cog, glb, npz, ply

ITEM_VERSION = 2
"""Raised when the STAC item of a tile changes for the same result."""
FORMATS = {"glb": glb, "ply": ply, "cog": cog, "npz": npz}


def product_versions(export: Export) -> dict[str, int]:
    """Return the versions of the item and of the exported formats."""
    return {"item": ITEM_VERSION} | {name: FORMATS[name].VERSION for name in export.formats}
