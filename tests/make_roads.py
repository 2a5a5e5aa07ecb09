"""Small vector files of roads for tests."""

from pathlib import Path

import geopandas
import numpy as np

from flexroad.catalog import Grid
from flexroad.tasks.types import Source, TileData

GRID = Grid("EPSG:25832", 400_000, 5_700_100, 1.0, 100, 100)
"""The tile that the roads lie on."""


def on_grid(*places: tuple[float, float]) -> list[tuple[float, float]]:
    """Return eastings and northings of places relative to the grid's south-west corner."""
    return [(GRID.west + x, GRID.south + y) for x, y in places]


def write(path: Path, shapes, crs: str | None = GRID.crs, layer: str | None = None, **columns) -> Path:
    geopandas.GeoDataFrame(columns or {"id": range(len(shapes))}, geometry=shapes, crs=crs).to_file(
        path, layer=layer
    )
    return path


def in_cp1252(path: Path, placeholder: str, text: str) -> Path:
    """Write a text of the same length in place of another one in cp1252; the file says UTF-8."""
    files = [path.with_suffix(".dbf")] if path.suffix == ".shp" else [path]
    for file in files:
        assert placeholder.encode() in file.read_bytes()
        file.write_bytes(file.read_bytes().replace(placeholder.encode(), text.encode("cp1252")))
    if path.suffix == ".shp":
        path.with_suffix(".cpg").write_text("UTF-8")
    return path


def tile(*paths: Path, grid: Grid = GRID, core: Grid | None = None, crs: str | None = None) -> TileData:
    """Return a flat tile whose layer ``roads`` has these files; without files it has no such layer."""
    flat = np.zeros(grid.shape)
    source = Source("roads", paths, crs) if paths else None
    return TileData("a", grid, core or grid, flat, flat, roads=source)


OSM = """<?xml version="1.0"?><osm version="0.6">
{nodes}
{ways}
</osm>"""


def write_osm(path: Path, ways: dict[str, list[tuple[float, float]]]) -> Path:
    """Write an OSM file; ways by tags ``k=v;k=v`` as longitudes and latitudes; equal places are one node."""
    numbers = {place: i + 1 for i, place in enumerate(dict.fromkeys(p for way in ways.values() for p in way))}
    nodes = [f'<node id="{i}" lon="{x:.9f}" lat="{y:.9f}"/>' for (x, y), i in numbers.items()]
    lines = []
    for i, (tags, places) in enumerate(ways.items()):
        xml_tags = "".join('<tag k="{}" v="{}"/>'.format(*tag.split("=")) for tag in tags.split(";"))
        refs = "".join(f'<nd ref="{numbers[place]}"/>' for place in places)
        lines.append(f'<way id="{i + 1}">{refs}{xml_tags}</way>')
    path.write_text(OSM.format(nodes="\n".join(nodes), ways="\n".join(lines)))
    return path
