"""STAC description of products: the assets of a tile's item and, without files, of the run's collection.

The items are written as plain dictionaries: to import pystac would cost every worker a fifth of a second.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any

from flexroad.catalog import Grid
from flexroad.pipeline.store.products import file_entry
from flexroad.pipeline.worker.exports import KINDS, Kind, Product
from flexroad.tasks.export.cog import Band

CLASSIFICATION = "https://stac-extensions.github.io/classification/v2.0.0/schema.json"
FILE = "https://stac-extensions.github.io/file/v2.1.0/schema.json"
RASTER = "https://stac-extensions.github.io/raster/v2.0.0/schema.json"
EXTENSIONS = (FILE, RASTER, CLASSIFICATION)
"""Extensions of the assets, besides the projection extension of the catalog's items."""
COLLECTION = "collection.json"
JSON, GEOJSON = "application/json", "application/geo+json"


def assets(files: Mapping[str, Product], variants: tuple[str, ...], grid: Grid) -> dict[str, Any]:
    """Return the assets of a tile's item from its files by name.

    The keys are the same for all tiles, as loaders of many items need them: ``height`` for the first of the
    exported variants, ``height_VARIANT`` for the others.
    """
    return {
        asset_key(product.kind, product.variant, variants): file_entry(
            name, product.data, product.kind.media_type
        )
        | _described(product.kind, product.variant, variants, grid.cell)
        | ({"flexroad:vertical_crs": product.vertical} if product.vertical else {})
        for name, product in files.items()
    }


def item_assets(variants: tuple[str, ...], formats: Iterable[str], cells: set[float]) -> dict[str, Any]:
    """Return what the assets of all items have in common, for a collection.

    Parameters
    ----------
    cells : set of float
        The cell sizes of the tiles (m).
    """
    cell = cells.copy().pop() if len(cells) == 1 else None
    return {
        asset_key(kind, variant, variants): {"type": kind.media_type}
        | _described(kind, variant, variants, cell)
        for variant in variants
        for name in formats
        for kind in KINDS[name]
    }


def asset_key(kind: Kind, variant: str, variants: tuple[str, ...]) -> str:
    """Return the key of the asset of a variant; ``variants`` are all that are exported."""
    return kind.key if variant == variants[0] else f"{kind.key}_{variant}"


def links(collection: str) -> list[dict[str, str]]:
    """Return the links of an item from its folder to the collection of its run."""
    up = f"../../{COLLECTION}"
    return [
        {"rel": rel, "href": up, "type": JSON, "title": collection}
        for rel in ("root", "parent", "collection")
    ]


def _described(kind: Kind, variant: str, variants: tuple[str, ...], cell: float | None) -> dict[str, Any]:
    """Return title, roles and bands of an asset."""
    title = kind.title if len(variants) == 1 else f"{kind.title} ({variant})"
    bands = {"bands": [_band(kind.band, cell)]} if kind.band else {}
    return {"title": title, "roles": ["data"]} | bands


def _band(band: Band, cell: float | None) -> dict[str, Any]:
    """Return an entry of STAC 1.1's ``bands``."""
    optional = {
        "unit": band.unit or None,
        # STAC writes NaN as text, because JSON has none.
        "nodata": "nan" if band.nodata is not None and math.isnan(band.nodata) else band.nodata,
        "raster:spatial_resolution": cell,
        "classification:classes": [
            {
                "value": c.value,
                "name": c.name,
                "description": c.meaning,
                "color_hint": "{:02X}{:02X}{:02X}".format(*c.colour),
            }
            for c in band.classes
        ]
        or None,
    }
    known = {name: value for name, value in optional.items() if value is not None}
    return {"name": band.name, "description": band.meaning, "data_type": band.dtype} | known
