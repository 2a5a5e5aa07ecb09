"""Small vector files of roads for tests."""

from pathlib import Path

import geopandas
import numpy as np

from flexroad.catalog import Grid
from flexroad.tasks.types import Source, TileData

GRID = Grid("EPSG:25832", 400_000, 5_700_100, 1.0, 100, 100)
"""The grid of the tile with the roads."""


def on_grid(*offsets: tuple[float, float]) -> list[tuple[float, float]]:
    """Return coordinates from offsets (m) from the grid's south-west corner."""
    return [(GRID.west + x, GRID.south + y) for x, y in offsets]


def write(path: Path, shapes, crs: str | None = GRID.crs, layer: str | None = None, **columns) -> Path:
    """Write shapes with attribute columns to a vector file."""
    geopandas.GeoDataFrame(columns or {"id": range(len(shapes))}, geometry=shapes, crs=crs).to_file(
        path, layer=layer
    )
    return path


def tile(*paths: Path, grid: Grid = GRID, core: Grid | None = None, crs: str | None = None) -> TileData:
    """A flat tile with these road files; without files it has no layer of roads."""
    flat = np.zeros(grid.shape)
    source = Source("roads", paths, crs) if paths else None
    return TileData("a", grid, core or grid, flat, flat, roads=source)


OSM = """<?xml version="1.0"?><osm version="0.6">
{nodes}
{ways}
</osm>"""


def write_osm(path: Path, ways: dict[str, list[tuple[float, float]]]) -> Path:
    """Write an OSM XML file from ``{"k=v;k=v": [(longitude, latitude), ...]}``; equal points share a node."""
    points = dict.fromkeys(point for way in ways.values() for point in way)
    numbers = {point: i + 1 for i, point in enumerate(points)}
    nodes = [f'<node id="{i}" lon="{x:.9f}" lat="{y:.9f}"/>' for (x, y), i in numbers.items()]
    lines = []
    for i, (tags, way) in enumerate(ways.items()):
        tag_elements = "".join('<tag k="{}" v="{}"/>'.format(*tag.split("=")) for tag in tags.split(";"))
        refs = "".join(f'<nd ref="{numbers[point]}"/>' for point in way)
        lines.append(f'<way id="{i + 1}">{refs}{tag_elements}</way>')
    path.write_text(OSM.format(nodes="\n".join(nodes), ways="\n".join(lines)))
    return path
