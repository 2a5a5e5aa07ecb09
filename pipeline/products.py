"""What a tile gives its user: meshes, rasters and the surface itself, in formats that open as they are."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from pipeline.graph import TileGraph
from tasks.nurbs import NurbsSurface

MEDIA = {
    "glb": "model/gltf-binary",
    "ply": "application/octet-stream",
    "cog": "image/tiff; application=geotiff; profile=cloud-optimized",
    "npz": "application/zip",
}


def products(
    graph: TileGraph, pull: Callable[[str], Any], origin: tuple[float, float]
) -> dict[str, tuple[bytes, str]]:
    """Return every product asked for: file name -> (bytes, media type).

    The surface itself is written for NURBS surfaces only; a plane and a raster are their own inputs.
    """
    made: dict[str, tuple[bytes, str]] = {}
    for variant in graph.export.variants:
        fingerprints = graph.variants[variant]
        stem = f"{graph.tile.id}_{variant}"
        for kind in graph.export.formats:
            for name, data in _one(kind, graph, fingerprints, pull, origin).items():
                made[f"{stem}{name}"] = (data, MEDIA[kind])
    return made


def _one(
    kind: str,
    graph: TileGraph,
    fingerprints: dict[str, str],
    pull: Callable[[str], Any],
    origin: tuple[float, float],
) -> dict[str, bytes]:
    from tasks.export import cog, glb, npz, ply

    if kind == "glb":
        return {".glb": glb.encode(pull(fingerprints["sample"]), (*origin, 0.0))}
    if kind == "ply":
        return {".ply": ply.encode(pull(fingerprints["sample"]))}
    surface = pull(fingerprints["fit"])
    if kind == "npz":
        return {"_surface.npz": npz.encode(surface)} if isinstance(surface, NurbsSurface) else {}
    core = graph.tile.grid
    road = pull(fingerprints["ecsrc"])
    heights = surface.lattice(core.eastings, core.northings)
    kept = road.mask[road.grid.window(core)]
    return {"_height.tif": cog.encode_height(heights, core), "_road.tif": cog.encode_mask(kept, core)}
