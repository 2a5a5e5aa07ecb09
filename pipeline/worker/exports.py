"""What a tile gives its user: meshes, rasters and the surface itself, in formats that open as they are."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from flexroad.pipeline.graph.graph import TileGraph
from flexroad.pipeline.store.products import safe_name
from flexroad.tasks.export import cog, glb, npz, ply
from flexroad.tasks.quality.support import of_faces
from flexroad.tasks.spline.surface import NurbsSurface

Product = tuple[bytes, str]
"""Bytes and media type."""
SUFFIXES = {
    "glb": (glb.NAME,),
    "ply": (ply.NAME,),
    "cog": (cog.NAME_HEIGHT, cog.NAME_ROAD, cog.NAME_SUPPORT),
    "npz": (npz.NAME,),
}
"""What the files of each format are called, after tile and variant."""


def products(graph: TileGraph, pull: Callable[[str], Any], origin: tuple[float, float]) -> dict[str, Product]:
    """Return every product asked for, by file name.

    Parameters
    ----------
    graph : TileGraph
        The tile, and what is asked for.
    pull : callable
        Gives the result of a node by its fingerprint.
    origin : tuple of float
        Whole-metre (easting, northing) that the run's meshes are placed against.
    """
    made: dict[str, Product] = {}
    tile = safe_name(graph.tile.id)
    for variant in graph.export.variants:
        for kind in graph.export.formats:
            found = _MAKERS[kind](graph, graph.variants[variant], pull, origin)
            made |= {f"{tile}_{variant}{suffix}": product for suffix, product in found.items()}
    return made


def _glb(
    graph: TileGraph, made: dict[str, str], pull: Callable[[str], Any], origin: tuple[float, float]
) -> dict[str, Product]:
    return {glb.NAME: (glb.encode(pull(made["sample"]), (*origin, 0.0)), glb.MEDIA_TYPE)}


def _ply(
    graph: TileGraph, made: dict[str, str], pull: Callable[[str], Any], origin: tuple[float, float]
) -> dict[str, Product]:
    mesh = pull(made["sample"])
    support = of_faces(pull(made["assess"]).support, pull(made["segment"]), mesh)
    return {ply.NAME: (ply.encode(mesh, support), ply.MEDIA_TYPE)}


def _cog(
    graph: TileGraph, made: dict[str, str], pull: Callable[[str], Any], origin: tuple[float, float]
) -> dict[str, Product]:
    core, road, surface = graph.tile.grid, pull(made["segment"]), pull(made["fit"])
    window = road.grid.window(core)
    heights = surface.lattice(core.eastings, core.northings)
    heights[road.outside[window]] = float("nan")
    kept = pull(made["ecsrc"]).mask[window]
    return {
        cog.NAME_HEIGHT: (cog.encode_height(heights, core), cog.MEDIA_TYPE),
        cog.NAME_ROAD: (cog.encode_mask(kept, core), cog.MEDIA_TYPE),
        cog.NAME_SUPPORT: (cog.encode_support(pull(made["assess"]).support, core), cog.MEDIA_TYPE),
    }


def _npz(
    graph: TileGraph, made: dict[str, str], pull: Callable[[str], Any], origin: tuple[float, float]
) -> dict[str, Product]:
    surface = pull(made["fit"])
    # A plane and a raster are no NURBS, and no more than what they were made from.
    return {npz.NAME: (npz.encode(surface), npz.MEDIA_TYPE)} if isinstance(surface, NurbsSurface) else {}


_MAKERS = {"glb": _glb, "ply": _ply, "cog": _cog, "npz": _npz}
