"""The products of a tile: meshes, rasters and the surface itself, in standard formats, and their STAC assets.

The assets are written to a tile's item and, without files, to the run's collection. They are plain
dictionaries, because an import of pystac would cost every worker a fifth of a second.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flexroad.catalog import Grid, Layer, Tile
from flexroad.catalog.ids import safe_name
from flexroad.catalog.scan.rasters import quiet
from flexroad.pipeline.graph.graph import TileGraph, product_layers
from flexroad.pipeline.store.products import file_entry
from flexroad.pipeline.worker.evaluator import check_unchanged
from flexroad.tasks.errors import LayerMissing
from flexroad.tasks.io.dsm_and_dtm import vertical_crs
from flexroad.tasks.io.orthophoto import read_photo
from flexroad.tasks.levels.seen import top_mask
from flexroad.tasks.load import layer_source
from flexroad.tasks.meshing.normals import mesh_normals
from flexroad.tasks.products import cog, glb, npz, ply
from flexroad.tasks.quality.height_source import of_faces, top_height_source
from flexroad.tasks.roads.attributes import HIGHEST_LEVEL
from flexroad.tasks.spline.surface import NurbsSurface
from flexroad.tasks.types import Bools, Orthophoto, Quality, Surface

CLASSIFICATION = "https://stac-extensions.github.io/classification/v2.0.0/schema.json"
FILE = "https://stac-extensions.github.io/file/v2.1.0/schema.json"
RASTER = "https://stac-extensions.github.io/raster/v2.0.0/schema.json"
EXTENSIONS = (FILE, RASTER, CLASSIFICATION)
"""Extensions of the assets, besides the projection extension of the catalog's items."""
COLLECTION = "collection.json"
NO_PHOTO = "dop: no orthophoto on the tile; its GLB has no texture"
QUALITY = 85
"""Quality of the texture's JPEG (percent), at which blocks are hardly visible."""
JSON, GEOJSON = "application/json", "application/geo+json"


@dataclass(frozen=True)
class Kind:
    """One kind of product, the same for all tiles."""

    key: str
    """Key of the STAC asset."""
    suffix: str
    """End of the file name, after tile and variant."""
    media_type: str
    title: str
    band: cog.Band | None = None
    """The band of a raster, None if it is not a raster."""


@dataclass(frozen=True)
class Product:
    """One file of a tile."""

    kind: Kind
    variant: str
    data: bytes
    vertical: str | None = None
    """Vertical CRS of heights, None if it is not known."""


GLB = Kind("mesh", glb.NAME, glb.MEDIA_TYPE, "Mesh for viewers: small coordinates, Y up")
PLY = Kind(
    "ply", ply.NAME, ply.MEDIA_TYPE, "Mesh in coordinates of the CRS, with class and height source per face"
)
HEIGHT = Kind("height", cog.NAME_HEIGHT, cog.MEDIA_TYPE, "Height of the surface", cog.HEIGHT)
ROAD = Kind("road", cog.NAME_ROAD, cog.MEDIA_TYPE, "Road mask after the filter", cog.ROAD)
HEIGHT_SOURCE = Kind(
    "height_source", cog.NAME_HEIGHT_SOURCE, cog.MEDIA_TYPE, "Source of each height", cog.HEIGHT_SOURCE
)
NPZ = Kind("surface", npz.NAME, npz.MEDIA_TYPE, "NURBS surface, as NumPy archive")
KINDS: dict[str, tuple[Kind, ...]] = {
    "glb": (GLB,),
    "ply": (PLY,),
    "cog": (HEIGHT, ROAD, HEIGHT_SOURCE),
    "npz": (NPZ,),
}
"""The kinds of product of each format."""


def of_level(kind: Kind, number: int) -> Kind:
    """Return the kind of raster for one level that lies below another level."""
    stem, ending = kind.suffix.split(".")
    title = f"{kind.title}, level {number}"
    return replace(
        kind, key=f"{kind.key}_level{number}", suffix=f"{stem}_level{number}.{ending}", title=title
    )


LEVEL_KINDS = tuple(
    of_level(kind, number) for kind in (HEIGHT, HEIGHT_SOURCE) for number in range(-HIGHEST_LEVEL, 1)
)
"""Further kinds of the format ``cog``, for tiles with decks or tunnels."""


def file_name(tile_id: str, variant: str, kind: Kind) -> str:
    """Return the name of a product in the tile's folder."""
    return f"{safe_name(tile_id)}_{variant}{kind.suffix}"


def product_names(tile_id: str, files: Iterable[str]) -> tuple[str, ...]:
    """Return which of the files in a tile's folder are products, of any variant and format."""
    kinds = (*itertools.chain(*KINDS.values()), *LEVEL_KINDS)
    start, ends = f"{safe_name(tile_id)}_", tuple(kind.suffix for kind in kinds)
    return tuple(sorted(name for name in files if name.startswith(start) and name.endswith(ends)))


def products(
    graph: TileGraph,
    evaluate: Callable[[str], Any],
    origin: tuple[float, float],
    texture: glb.Texture | None = None,
) -> dict[str, Product]:
    """Return the products of the graph's export variants and formats, by file name.

    - `evaluate`: returns the result of a node by its fingerprint.
    - `origin`: origin of the run: whole-metre (easting, northing) that mesh translations are relative to.
    """
    vertical = vertical_crs(graph.tile) if "cog" in graph.export.formats else None
    files: dict[str, Product] = {}
    for variant in graph.export.variants:
        nodes = graph.variants[variant]
        normals = None
        if not {"glb", "ply"}.isdisjoint(graph.export.formats):
            normals = mesh_normals(evaluate(nodes["sample"]), evaluate(nodes["fit"]))
        for name in graph.export.formats:
            if name == "glb":
                mesh = evaluate(nodes["sample"])
                encoded = {GLB: glb.encode(mesh, (*origin, 0.0), texture, normals, graph.tile.id)}
            elif name == "ply":
                mesh, quality = evaluate(nodes["sample"]), evaluate(nodes["assess"])
                sources = of_faces(quality.height_source, evaluate(nodes["segment"]), mesh, quality.levels)
                encoded = {PLY: ply.encode(mesh, sources, normals)}
            elif name == "cog":
                encoded = _cog(graph.tile.grid, nodes, evaluate, vertical)
            else:
                surface = evaluate(nodes["fit"])
                # Planes and rasters are not NURBS surfaces, and their npz would only repeat the input.
                encoded = {NPZ: npz.encode(surface)} if isinstance(surface, NurbsSurface) else {}
            for kind, data in encoded.items():
                known = vertical if kind.band is cog.HEIGHT else None
                files[file_name(graph.tile.id, variant, kind)] = Product(kind, variant, data, known)
    return files


def _cog(
    core: Grid, nodes: dict[str, str], evaluate: Callable[[str], Any], vertical: str | None
) -> dict[Kind, bytes]:
    road, surface = evaluate(nodes["segment"]), evaluate(nodes["fit"])
    window = road.grid.window(core)
    # Rasters show the highest level, like the DSM.
    heights = surface.highest.lattice(core.eastings, core.northings)
    heights[road.outside[window]] = float("nan")
    kept, quality = top_mask(evaluate(nodes["ecsrc"]))[window], evaluate(nodes["assess"])
    # Without a common environment, GDAL's environment would be set up and cleared for each call.
    with quiet():
        height_source, others = _of_levels(core, road.outside[window], surface, quality, vertical)
        return {
            HEIGHT: cog.encode(heights, core, cog.HEIGHT, vertical),
            ROAD: cog.encode(kept, core, cog.ROAD),
            HEIGHT_SOURCE: cog.encode(height_source, core, cog.HEIGHT_SOURCE),
            **others,
        }


def _of_levels(
    core: Grid, outside: Bools, surface: Surface, quality: Quality, vertical: str | None
) -> tuple[NDArray[np.uint8], dict[Kind, bytes]]:
    """Return the height source of the highest level, and rasters of level 0 below decks and of tunnels."""
    at = np.meshgrid(core.eastings, core.northings)
    top, lower = surface.top(*at), {}
    if (top > 0).any():
        lower[0] = surface.lattice(core.eastings, core.northings)
        lower[0][outside] = np.nan
    for number in surface.numbers:
        here = surface.covers(number, *at) if number < 0 else np.zeros(core.shape, np.bool_)
        if here.any():
            lower[number] = np.where(here, surface.at(number).height(*at), np.nan)
    files = {}
    for number, heights in sorted(lower.items()):
        files[of_level(HEIGHT, number)] = cog.encode(heights, core, cog.HEIGHT, vertical)
        files[of_level(HEIGHT_SOURCE, number)] = cog.encode(
            quality.at(number).height_source, core, cog.HEIGHT_SOURCE
        )
    return top_height_source(quality, top), files


def assets(files: Mapping[str, Product], variants: tuple[str, ...], grid: Grid) -> dict[str, Any]:
    """Return the assets of a tile's item from its files by name.

    Loaders of many items need equal keys for all tiles: ``height`` for the first exported variant,
    ``height_VARIANT`` for the other variants.
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
    """Return the common fields of the assets of all items, for a collection."""
    cell = cells.copy().pop() if len(cells) == 1 else None
    return {
        asset_key(kind, variant, variants): {"type": kind.media_type}
        | _described(kind, variant, variants, cell)
        for variant in variants
        for name in formats
        for kind in KINDS[name]
    }


def asset_key(kind: Kind, variant: str, variants: tuple[str, ...]) -> str:
    """Return the key of the asset of a variant; ``variants`` are all exported variants."""
    return kind.key if variant == variants[0] else f"{kind.key}_{variant}"


def _described(kind: Kind, variant: str, variants: tuple[str, ...], cell: float | None) -> dict[str, Any]:
    """Return title, roles and bands of an asset."""
    title = kind.title if len(variants) == 1 else f"{kind.title} ({variant})"
    bands = {"bands": [_band(kind.band, cell)]} if kind.band else {}
    return {"title": title, "roles": ["data"]} | bands


def _band(band: cog.Band, cell: float | None) -> dict[str, Any]:
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


def tile_texture(graph: TileGraph) -> tuple[glb.Texture | None, str]:
    """Return the texture of a tile's meshes: its orthophoto, at its own resolution up to `export.texture_px`.

    - `texture`: None if it is not configured, or the tile has no photo.
    - `note`: the part without a photo, or empty.
    """
    export, tile = graph.export, graph.tile
    if not export.texture:
        return None, ""
    layers = tile.layers_on(product_layers(export))
    if not layers:
        return None, NO_PHOTO
    (layer,) = layers
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
