"""A synthetic town in OSM's format: some 30 streets, decks, a tunnel, and tags that name no level."""

from itertools import pairwise
from pathlib import Path

import numpy as np
from pyproj import Transformer

from flexroad.catalog import Catalog
from flexroad.catalog.grid import Bounds, union
from flexroad.catalog.scan.vectors import opened, with_roads
from flexroad.tools.synthetic import block, prepared
from flexroad.tools.synthetic.crossings import REACH_M, CrossingOptions, Crossings, make_crossings
from tests.make_roads import write_osm

CRS = "EPSG:25832"
OPTIONS = CrossingOptions(tunnels=0.5)
"""Of the crossings every second one is a tunnel."""
SIDE_STREETS_M = (-75.0, -55.0, -35.0, 35.0, 55.0, 75.0)
"""Distances of the side streets from the main road, along the crossing roads (m)."""
SIDE_TAGS = ("layer=1", "bridge=no", "tunnel=no;layer=-1", "covered=yes", "layer=2", "bridge=no;layer=1")
"""Tags of side streets on level 0."""


def make_town(folder: Path, tiles: int = 4, size_m: int = 250, seed: int = 1) -> Path:
    """Write the tiles of a town and its streets, ``town.osm``; return the path of the catalog."""
    written = [
        prepared.write_tile(folder, name, grid, make_crossings(grid, seed, OPTIONS).layers)
        for name, grid in block(tiles, size_m)
    ]
    bounds = union([tile.grid.bounds for tile in written])
    streets = write_streets(folder / "town.osm", bounds, seed)
    catalog = Catalog(with_roads(prepared.with_neighbours(written), [opened(streets, None)], None)[0])
    catalog.write(folder / "catalog.parquet")
    return folder / "catalog.parquet"


def write_streets(path: Path, bounds: Bounds, seed: int = 1) -> Path:
    """Write the streets of the town within some bounds as an OSM file."""
    return write_osm(path, _ways(Crossings(seed, OPTIONS), bounds))


def _ways(world: Crossings, bounds: Bounds) -> dict[str, list[tuple[float, float]]]:
    """Return the places of the streets (degrees) by their tags, which a name makes unique."""
    lines = world.roads(bounds)
    crossing = [line.points for line in lines if line.width_m == 7]
    ways = {_tags(line, f"{k}"): line.points for k, line in enumerate(lines)}
    for k, (left, right) in enumerate(pairwise(crossing)):
        for at, more in zip(SIDE_STREETS_M, SIDE_TAGS, strict=True):
            share = (at + REACH_M) / (2 * REACH_M)
            ends = [points[0] + share * (points[1] - points[0]) for points in (left, right)]
            ways[f"highway=residential;name=side {k} {at:g};width=6;{more}"] = np.array(ends)
    # A path along a crossing road is not a carriageway.
    ways["highway=footway;name=path"] = crossing[0] + (6.0, 0.0)
    degrees = Transformer.from_crs(CRS, "EPSG:4326", always_xy=True)
    return {tags: list(zip(*degrees.transform(*points.T), strict=True)) for tags, points in ways.items()}


def _tags(line, name: str) -> str:
    tags = f"highway={line.highway};name={name};width={line.width_m:g}"
    kind = {1: ";bridge=yes;layer=1", -1: ";tunnel=yes;layer=-1"}
    return tags + kind.get(line.level, "")
