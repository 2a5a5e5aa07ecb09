"""The rasters of all done tiles as one: ``RUN/height.vrt`` and the like, which name the tiles' files.

A VRT is GDAL's format for this; its own builder is not in rasterio. The file is written as a stream, because
a state has hundreds of thousands of tiles.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from xml.sax.saxutils import XMLGenerator, escape
from xml.sax.xmlreader import AttributesImpl

from flexroad.catalog import Grid, Tile
from flexroad.catalog.grid import LATTICE_TOLERANCE
from flexroad.catalog.ids import safe_name
from flexroad.catalog.storage.paths import remove
from flexroad.catalog.storage.staging import atomic_file
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.worker.exports import KINDS, Kind, file_name
from flexroad.tasks.export.cog import BLOCK, Band

MOST_CELLS = 2**31 - 1
"""Largest width and height of a raster in GDAL."""
TYPES = {"float32": "Float32", "uint8": "Byte"}
"""GDAL's names of the types of cells."""


def write_mosaics(run: Run, done: Sequence[Tile]) -> list[Kind]:
    """Write a VRT for each raster of the main variant over the done tiles; return their kinds.

    Tiles without a common lattice, or without exported rasters, give none; older files are then removed.

    Raises
    ------
    OSError
        If one cannot be written.
    """
    grid = common_grid([tile.grid for tile in done]) if "cog" in run.config.export.formats else None
    written = []
    for kind in KINDS["cog"]:
        path = run.path / vrt_name(kind)
        if grid is None or kind.band is None:
            remove(path)
            continue
        with atomic_file(path, run.config.cluster.flush) as local, local.open("w", encoding="utf-8") as file:
            xml = XMLGenerator(file, "utf-8", short_empty_elements=True)
            _write(xml, grid, kind, kind.band, done, run.config.export.variants[0])
        written.append(kind)
    return written


def vrt_name(kind: Kind) -> str:
    """Return the name of the mosaic of a kind of raster."""
    return f"{kind.key}.vrt"


def common_grid(grids: Sequence[Grid]) -> Grid | None:
    """Return the smallest grid that has the cells of all grids, None if their lattices or CRSs differ."""
    if not grids:
        return None
    first = grids[0]
    west, north = min(grid.west for grid in grids), max(grid.north for grid in grids)
    east, south = max(grid.east for grid in grids), min(grid.south for grid in grids)
    for grid in grids:
        off = max(
            abs(x - round(x)) for x in ((grid.west - west) / first.cell, (north - grid.north) / first.cell)
        )
        if (grid.crs, grid.cell) != (first.crs, first.cell) or off > LATTICE_TOLERANCE:
            return None
    whole = Grid(
        first.crs, west, north, first.cell, *(round(d / first.cell) for d in (east - west, north - south))
    )
    return whole if max(whole.width, whole.height) <= MOST_CELLS else None


def _write(
    xml: XMLGenerator, grid: Grid, kind: Kind, band: Band, tiles: Sequence[Tile], variant: str
) -> None:
    _begin(xml, "VRTDataset", rasterXSize=str(grid.width), rasterYSize=str(grid.height))
    _leaf(xml, "SRS", grid.crs)
    _leaf(xml, "GeoTransform", f"{grid.west!r}, {grid.cell!r}, 0.0, {grid.north!r}, 0.0, {-grid.cell!r}")
    _begin(xml, "VRTRasterBand", dataType=TYPES[band.dtype], band="1")
    _describe(xml, band)
    for tile in tiles:
        name = f"tiles/{safe_name(tile.id)}/{file_name(tile.id, variant, kind)}"
        _source(xml, name, grid, tile.grid, band)
    xml.endElement("VRTRasterBand")
    xml.endElement("VRTDataset")


def _describe(xml: XMLGenerator, band: Band) -> None:
    """Write name, unit, nodata, colours and names of classes."""
    _leaf(xml, "Description", band.name)
    if band.unit:
        _leaf(xml, "UnitType", band.unit)
    if band.nodata is not None:
        _leaf(xml, "NoDataValue", _number(band.nodata))
    if not band.classes:
        _leaf(xml, "ColorInterp", "Gray")
        return
    _leaf(xml, "ColorInterp", "Palette")
    _begin(xml, "CategoryNames")
    for one in band.classes:
        _leaf(xml, "Category", one.name)
    xml.endElement("CategoryNames")
    _begin(xml, "ColorTable")
    for one in band.classes:
        red, green, blue = map(str, one.colour)
        _leaf(xml, "Entry", c1=red, c2=green, c3=blue, c4="255")
    xml.endElement("ColorTable")


def _source(xml: XMLGenerator, name: str, whole: Grid, tile: Grid, band: Band) -> None:
    """Write the file of one tile; where it has nodata, other tiles show."""
    kind = "SimpleSource" if band.nodata is None else "ComplexSource"
    size = f'xSize="{tile.width}" ySize="{tile.height}"'
    left, top = round((tile.west - whole.west) / whole.cell), round((whole.north - tile.north) / whole.cell)
    nodata = "" if band.nodata is None else f"<NODATA>{_number(band.nodata)}</NODATA>"
    # Written as text, because element by element it takes several times as long. With the properties, GDAL
    # does not open all files when it opens the mosaic.
    xml.ignorableWhitespace(
        f'<{kind}><SourceFilename relativeToVRT="1">{escape(name)}</SourceFilename><SourceBand>1</SourceBand>'
        f'<SourceProperties RasterXSize="{tile.width}" RasterYSize="{tile.height}" '
        f'DataType="{TYPES[band.dtype]}" BlockXSize="{BLOCK}" BlockYSize="{BLOCK}"/>'
        f'<SrcRect xOff="0" yOff="0" {size}/><DstRect xOff="{left}" yOff="{top}" {size}/>{nodata}</{kind}>'
    )


def _begin(xml: XMLGenerator, name: str, **attributes: str) -> None:
    xml.startElement(name, AttributesImpl(attributes))


def _leaf(xml: XMLGenerator, name: str, text: str = "", **attributes: str) -> None:
    _begin(xml, name, **attributes)
    xml.characters(text)
    xml.endElement(name)


def _number(value: float) -> str:
    return "nan" if math.isnan(value) else f"{value:g}"
