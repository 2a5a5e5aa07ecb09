"""The products of a tile: meshes, rasters and the surface itself, in standard formats."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from flexroad.catalog.ids import safe_name
from flexroad.pipeline.graph.graph import TileGraph
from flexroad.tasks.export import cog, glb, npz, ply
from flexroad.tasks.quality.support import of_faces
from flexroad.tasks.spline.surface import NurbsSurface

Product = tuple[bytes, str]
"""Content (bytes) and media type of a file."""
SUFFIXES = {
    "glb": (glb.NAME,),
    "ply": (ply.NAME,),
    "cog": (cog.NAME_HEIGHT, cog.NAME_ROAD, cog.NAME_SUPPORT),
    "npz": (npz.NAME,),
}
"""Ends of the file names of each format, after tile and variant."""


def products(
    graph: TileGraph, evaluate: Callable[[str], Any], origin: tuple[float, float]
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
    """
    files: dict[str, Product] = {}
    tile = safe_name(graph.tile.id)
    for variant in graph.export.variants:
        for kind in graph.export.formats:
            by_suffix = _ENCODERS[kind](graph, graph.variants[variant], evaluate, origin)
            files |= {f"{tile}_{variant}{suffix}": product for suffix, product in by_suffix.items()}
    return files


def _glb(
    graph: TileGraph, nodes: dict[str, str], evaluate: Callable[[str], Any], origin: tuple[float, float]
) -> dict[str, Product]:
    return {glb.NAME: (glb.encode(evaluate(nodes["sample"]), (*origin, 0.0)), glb.MEDIA_TYPE)}


def _ply(
    graph: TileGraph, nodes: dict[str, str], evaluate: Callable[[str], Any], origin: tuple[float, float]
) -> dict[str, Product]:
    mesh = evaluate(nodes["sample"])
    support = of_faces(evaluate(nodes["assess"]).support, evaluate(nodes["segment"]), mesh)
    return {ply.NAME: (ply.encode(mesh, support), ply.MEDIA_TYPE)}


def _cog(
    graph: TileGraph, nodes: dict[str, str], evaluate: Callable[[str], Any], origin: tuple[float, float]
) -> dict[str, Product]:
    core, road, surface = graph.tile.grid, evaluate(nodes["segment"]), evaluate(nodes["fit"])
    window = road.grid.window(core)
    heights = surface.lattice(core.eastings, core.northings)
    heights[road.outside[window]] = float("nan")
    kept = evaluate(nodes["ecsrc"]).mask[window]
    return {
        cog.NAME_HEIGHT: (cog.encode_height(heights, core), cog.MEDIA_TYPE),
        cog.NAME_ROAD: (cog.encode_mask(kept, core), cog.MEDIA_TYPE),
        cog.NAME_SUPPORT: (cog.encode_support(evaluate(nodes["assess"]).support, core), cog.MEDIA_TYPE),
    }


def _npz(
    graph: TileGraph, nodes: dict[str, str], evaluate: Callable[[str], Any], origin: tuple[float, float]
) -> dict[str, Product]:
    surface = evaluate(nodes["fit"])
    # Planes and rasters have no NURBS form, and their npz would only repeat the input.
    return {npz.NAME: (npz.encode(surface), npz.MEDIA_TYPE)} if isinstance(surface, NurbsSurface) else {}


_ENCODERS = {"glb": _glb, "ply": _ply, "cog": _cog, "npz": _npz}
