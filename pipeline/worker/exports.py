"""The products of a tile: meshes, rasters and the surface itself, in standard formats."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

from flexroad.catalog.ids import safe_name
from flexroad.catalog.lazy import lazy
from flexroad.pipeline.graph.graph import TileGraph
from flexroad.tasks.export import cog, glb, npz, ply
from flexroad.tasks.io.vertical import vertical_crs
from flexroad.tasks.quality.support import of_faces
from flexroad.tasks.spline.surface import NurbsSurface

rasterio = lazy("rasterio")


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
    """The band of a raster, None if it is no raster."""


@dataclass(frozen=True)
class Product:
    """One file of a tile."""

    kind: Kind
    variant: str
    data: bytes
    vertical: str | None = None
    """Vertical CRS of heights, None if it is not known."""


@dataclass(frozen=True)
class Reference:
    """What the products of a tile share, besides its results."""

    origin: tuple[float, float]
    """Whole-metre (easting, northing) that mesh translations are relative to."""
    vertical: str | None
    """Vertical CRS of heights, None if it is not known."""
    texture: glb.Texture | None
    """The photo on the mesh, None if it has none."""


GLB = Kind("mesh", glb.NAME, glb.MEDIA_TYPE, "Mesh for viewers: small coordinates, Y up")
PLY = Kind("ply", ply.NAME, ply.MEDIA_TYPE, "Mesh in coordinates of the CRS, with class and support per face")
HEIGHT = Kind("height", cog.NAME_HEIGHT, cog.MEDIA_TYPE, "Height of the surface", cog.HEIGHT)
ROAD = Kind("road", cog.NAME_ROAD, cog.MEDIA_TYPE, "Road mask after the filter", cog.ROAD)
SUPPORT = Kind("support", cog.NAME_SUPPORT, cog.MEDIA_TYPE, "Source of each height", cog.SUPPORT)
NPZ = Kind("surface", npz.NAME, npz.MEDIA_TYPE, "NURBS surface, as NumPy archive")
KINDS: dict[str, tuple[Kind, ...]] = {
    "glb": (GLB,),
    "ply": (PLY,),
    "cog": (HEIGHT, ROAD, SUPPORT),
    "npz": (NPZ,),
}
"""The kinds of product of each format."""


def file_name(tile_id: str, variant: str, kind: Kind) -> str:
    """Return the name of a product in the tile's folder."""
    return f"{safe_name(tile_id)}_{variant}{kind.suffix}"


def product_names(tile_id: str, files: Iterable[str]) -> tuple[str, ...]:
    """Return which of the files in a tile's folder are products, of any variant and format."""
    start, ends = f"{safe_name(tile_id)}_", tuple(kind.suffix for kinds in KINDS.values() for kind in kinds)
    return tuple(sorted(name for name in files if name.startswith(start) and name.endswith(ends)))


def products(
    graph: TileGraph,
    evaluate: Callable[[str], Any],
    origin: tuple[float, float],
    texture: glb.Texture | None = None,
) -> dict[str, Product]:
    """Return the products of the graph's export variants and formats, by file name.

    Parameters
    ----------
    graph : TileGraph
        The tile's graph, with the export options.
    evaluate : callable
        Returns the result of a node by its fingerprint.
    origin : tuple of float
        Origin of the run: whole-metre (easting, northing) that mesh translations are relative to.
    texture : Texture, optional
        The photo on the mesh.
    """
    vertical = vertical_crs(graph.tile) if "cog" in graph.export.formats else None
    reference = Reference(origin, vertical, texture)
    files: dict[str, Product] = {}
    for variant in graph.export.variants:
        for name in graph.export.formats:
            for kind, data in _ENCODERS[name](graph, graph.variants[variant], evaluate, reference).items():
                known = vertical if kind is HEIGHT else None
                files[file_name(graph.tile.id, variant, kind)] = Product(kind, variant, data, known)
    return files


def _glb(
    graph: TileGraph, nodes: dict[str, str], evaluate: Callable[[str], Any], reference: Reference
) -> dict[Kind, bytes]:
    mesh, surface = evaluate(nodes["sample"]), evaluate(nodes["fit"])
    return {GLB: glb.encode(mesh, (*reference.origin, 0.0), reference.texture, surface)}


def _ply(
    graph: TileGraph, nodes: dict[str, str], evaluate: Callable[[str], Any], reference: Reference
) -> dict[Kind, bytes]:
    mesh = evaluate(nodes["sample"])
    support = of_faces(evaluate(nodes["assess"]).support, evaluate(nodes["segment"]), mesh)
    return {PLY: ply.encode(mesh, support)}


def _cog(
    graph: TileGraph, nodes: dict[str, str], evaluate: Callable[[str], Any], reference: Reference
) -> dict[Kind, bytes]:
    core, road, surface = graph.tile.grid, evaluate(nodes["segment"]), evaluate(nodes["fit"])
    window = road.grid.window(core)
    heights = surface.lattice(core.eastings, core.northings)
    heights[road.outside[window]] = float("nan")
    kept = evaluate(nodes["ecsrc"]).mask[window]
    support = evaluate(nodes["assess"]).support
    # Without a common one, GDAL's environment is set up and cleared for each call.
    with rasterio.Env():
        return {
            HEIGHT: cog.encode_height(heights, core, reference.vertical),
            ROAD: cog.encode_mask(kept, core),
            SUPPORT: cog.encode_support(support, core),
        }


def _npz(
    graph: TileGraph, nodes: dict[str, str], evaluate: Callable[[str], Any], reference: Reference
) -> dict[Kind, bytes]:
    surface = evaluate(nodes["fit"])
    # Planes and rasters have no NURBS form, and their npz would only repeat the input.
    return {NPZ: npz.encode(surface)} if isinstance(surface, NurbsSurface) else {}


_ENCODERS = {"glb": _glb, "ply": _ply, "cog": _cog, "npz": _npz}
