"""Versions of the products of a tile: a tile of an older version is exported again, from the store."""

from __future__ import annotations

from typing import Any

from flexroad.pipeline.config.models import Export
from flexroad.tasks.export import cog, glb, npz, ply

ITEM_VERSION = 2
"""Raised when the STAC item of a tile changes for the same result."""
PHOTO = "texture"
"""Start of the names of the options of the photo on the mesh."""
FORMATS = {"glb": glb, "ply": ply, "cog": cog, "npz": npz}


def product_versions(export: Export) -> dict[str, int]:
    """Return the versions of the item and of the exported formats."""
    return {"item": ITEM_VERSION} | {name: FORMATS[name].VERSION for name in export.formats}


def product_options(export: Export) -> dict[str, Any]:
    """Return the options that the products depend on: without a texture not those of the texture."""
    options: dict[str, Any] = export.model_dump(mode="json")
    if export.texture:
        return options
    return {name: value for name, value in options.items() if not name.startswith(PHOTO)}


def product_layers(export: Export) -> tuple[str, ...]:
    """Return the names of the source layers that the products are made of."""
    return ("dop",) if export.texture else ()
