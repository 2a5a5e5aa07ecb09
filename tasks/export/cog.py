"""Heights (the paper's R^S), road mask and support of a tile as cloud-optimised GeoTIFF."""

from __future__ import annotations

import struct
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np
from isal import isal_zlib
from numpy.typing import NDArray

from flexroad.catalog.crs import compound
from flexroad.catalog.grid import Grid
from flexroad.catalog.lazy import lazy
from flexroad.tasks.errors import TaskError
from flexroad.tasks.quality.support import Support
from flexroad.tasks.types import Bools, Floats

rasterio = lazy("rasterio")

VERSION = 4
NAME_HEIGHT = "_height.tif"
NAME_ROAD = "_road.tif"
NAME_SUPPORT = "_support.tif"
NAME_STYLE = ".qml"
MEDIA_TYPE = "image/tiff; application=geotiff; profile=cloud-optimized"
BLOCK = 512
"""Largest width and height of the blocks of a file (cells)."""
BLOCK_MULTIPLE = 16
"""TIFF wants blocks whose width and height are multiples of this (cells)."""
STYLE_DOCTYPE = b"<!DOCTYPE qgis PUBLIC 'http://mrcc.com/qgis.dtd' 'SYSTEM'>\n"
HILLSHADE = {"type": "hillshade", "azimuth": "315", "angle": "45", "zfactor": "1", "multidirection": "0"}
RENDERER = {"band": "1", "opacity": "1", "alphaBand": "-1"}
"""Attributes of QGIS's renderers of rasters."""
LEVEL = 4
"""Level of GDAL's deflate, 1 to 9: above it, heights get 2% smaller in up to twice the time."""
ISAL_LEVEL = 1
"""Level of ISA-L's deflate, 0 to 3: at 0 files are a sixth larger, above 1 no smaller."""
ENTRY = "<2H2L"
"""An entry of a TIFF directory: tag, type, number of values, and the value or the place of several."""
TILE_OFFSETS, TILE_BYTE_COUNTS, TIE_POINT = 324, 325, 33922
"""TIFF's tags of the places and sizes of blocks, and GeoTIFF's of a cell and its coordinates."""
LONG = 4
"""TIFF's type of 32-bit integers."""
SIZE_BYTES, DOUBLE_BYTES = 4, 8


@dataclass(frozen=True)
class RasterClass:
    """A value of a raster with classes."""

    value: int
    name: str
    """One word, as the STAC classification extension requires."""
    meaning: str
    colour: tuple[int, int, int]
    """Red, green, blue: 0 to 255."""


@dataclass(frozen=True)
class Band:
    """What the cells of a raster mean."""

    name: str
    meaning: str
    dtype: str
    unit: str = ""
    nodata: float | None = None
    classes: tuple[RasterClass, ...] = ()
    """All values, in ascending order from 0; empty for heights."""


HEIGHT = Band("height", "Height of the surface at the cell centre", "float32", "m", float("nan"))
ROAD = Band(
    "road",
    "Road mask after the filter",
    "uint8",
    classes=(
        RasterClass(0, "other", "No road, or road that the filter removed", (232, 232, 226)),
        RasterClass(1, "road", "Road that the surface follows", (70, 70, 80)),
    ),
)
SUPPORT = Band(
    "support",
    "Source of the surface's height",
    "uint8",
    nodata=int(Support.NONE),
    classes=(
        RasterClass(Support.NONE, "outside", "Beyond the survey", (255, 255, 255)),
        RasterClass(Support.MEASURED, "measured", "The surface model shows the ground", (90, 160, 90)),
        RasterClass(Support.DTM, "dtm", "Hidden ground: the height comes from the DTM", (240, 190, 70)),
        RasterClass(Support.INFERRED, "inferred", "No height: extrapolated from around", (205, 80, 70)),
    ),
)


def encode_height(height: Floats, grid: Grid, vertical: str | None = None) -> bytes:
    """Return heights at the cell centres of a grid, ``(H, W)``, m, as GeoTIFF: float32, nodata NaN.

    Parameters
    ----------
    vertical : str, optional
        Vertical CRS of the heights; the file's CRS is then compound.

    Raises
    ------
    TaskError
        If the array does not have the grid's shape.
    """
    crs = compound(grid.crs, vertical) if vertical else grid.crs
    return _encode(height.astype(np.float32), grid, crs, HEIGHT)


def encode_mask(road: Bools, grid: Grid) -> bytes:
    """Return a road mask, ``(H, W)``, as GeoTIFF: uint8, 1 is road.

    Raises
    ------
    TaskError
        If the array does not have the grid's shape.
    """
    return _encode(road.astype(np.uint8), grid, grid.crs, ROAD)


def encode_support(support: NDArray[np.uint8], grid: Grid) -> bytes:
    """Return the `Support` of each cell, ``(H, W)``, as GeoTIFF: uint8; 0 is nodata.

    Raises
    ------
    TaskError
        If the array does not have the grid's shape.
    """
    return _encode(support, grid, grid.crs, SUPPORT)


def encode_style(band: Band) -> bytes:
    """Return the look of a raster of one band in QGIS, which reads it from a file of the same name beside it.

    Classes have their names and colours, of which the raster has the colours alone. Heights are a hillshade.
    """
    style = ET.Element("qgis", {"version": "3.28.0", "styleCategories": "Symbology"})
    pipe = ET.SubElement(style, "pipe")
    kind = {"type": "paletted"} if band.classes else HILLSHADE
    renderer = ET.SubElement(pipe, "rasterrenderer", kind | RENDERER)
    if band.classes:
        palette = ET.SubElement(renderer, "colorPalette")
        for entry in band.classes:
            if entry.value != band.nodata:
                colour = "#{:02x}{:02x}{:02x}".format(*entry.colour)
                ET.SubElement(
                    palette,
                    "paletteEntry",
                    {"value": f"{entry.value:d}", "color": colour, "alpha": "255", "label": entry.meaning},
                )
    ET.indent(style, " ")
    text: bytes = ET.tostring(style, "utf-8")
    return STYLE_DOCTYPE + text + b"\n"


@dataclass(frozen=True)
class _Frame:
    """A raster of one block as GDAL writes it, without the block."""

    head: bytes
    """All that comes before the block: the header and the directory, which refers to the block."""
    offset: int
    """Where the directory's entry for the offset of the block is (bytes)."""
    count: int
    """Where its entry for the size of the block is (bytes)."""
    corner: int
    """Where easting and northing of the north-west corner are (bytes)."""

    def of(self, block: bytes, corner: tuple[float, float]) -> bytes:
        """Return the raster with a compressed block, at a place."""
        head = bytearray(self.head)
        struct.pack_into(ENTRY, head, self.offset, TILE_OFFSETS, LONG, 1, len(head) + SIZE_BYTES)
        struct.pack_into(ENTRY, head, self.count, TILE_BYTE_COUNTS, LONG, 1, len(block))
        struct.pack_into("<2d", head, self.corner, *corner)
        # GDAL's layout of a COG: before a block its size, after it its last four bytes again.
        return b"".join([head, struct.pack("<L", len(block)), block, block[-4:]])


def _encode(values: NDArray[Any], grid: Grid, crs: str, band: Band) -> bytes:
    if values.shape != grid.shape:
        raise TaskError(f"{band.name} of {values.shape} cells does not fit a grid of {grid.shape}")
    if max(grid.shape) > BLOCK:
        return _written(values, grid, crs, band)
    # The rasters of a run differ in corner and cells alone: GDAL takes longer for the rest than for these.
    frame = _frame(replace(grid, west=1.0, north=1.0), crs, band)
    block = np.pad(values, [(0, _block(grid) - size) for size in grid.shape], mode="edge")
    if not band.classes:
        block = _predicted(block)
    return frame.of(isal_zlib.compress(block, ISAL_LEVEL), (grid.west, grid.north))


@lru_cache(maxsize=256)
def _frame(grid: Grid, crs: str, band: Band) -> _Frame:
    """Return the frame of a raster that is one block."""
    encoded = _written(np.ones(grid.shape, band.dtype), grid, crs, band)
    (directory,) = struct.unpack_from("<L", encoded, 4)
    (count,) = struct.unpack_from("<H", encoded, directory)
    places = [directory + 2 + struct.calcsize(ENTRY) * number for number in range(count)]
    entries = [struct.unpack_from(ENTRY, encoded, place) for place in places]
    values = {tag: value for tag, _, _, value in entries}
    place = {tag: start for (tag, *_), start in zip(entries, places, strict=True)}
    return _Frame(
        head=encoded[: values[TILE_OFFSETS] - SIZE_BYTES],
        offset=place[TILE_OFFSETS],
        count=place[TILE_BYTE_COUNTS],
        # A tie point has column, row and layer of a cell, then its easting, northing and height.
        corner=values[TIE_POINT] + 3 * DOUBLE_BYTES,
    )


def _predicted(block: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Return TIFF's floating-point predictor: in each row the highest bytes of all cells, then the next ones.

    Each byte is the difference from the one before it.
    """
    height, width = block.shape
    rows = block.astype(">f4").view(np.uint8).reshape(height, width, 4).transpose(0, 2, 1)
    return np.diff(rows.reshape(height, 4 * width), axis=1, prepend=np.zeros((height, 1), np.uint8))


def _written(values: NDArray[Any], grid: Grid, crs: str, band: Band) -> bytes:
    """Return a raster as GDAL writes it, with overviews if it has several blocks."""
    profile = {
        "driver": "COG",
        "dtype": band.dtype,
        "count": 1,
        "width": grid.width,
        "height": grid.height,
        "crs": crs,
        "transform": grid.transform,
        "compress": "deflate",
        "level": LEVEL,
        "nodata": band.nodata,
        "blocksize": _block(grid),
        "overview_resampling": "mode" if band.classes else "average",
        "predictor": "NO" if band.classes else "FLOATING_POINT",
    }
    with rasterio.io.MemoryFile() as file:
        with file.open(**profile) as raster:
            raster.write(values, 1)
            describe(raster, 1, band)
        encoded: bytes = file.read()
    return encoded


def _block(grid: Grid) -> int:
    """Return the size of the blocks: a raster of one block is not filled up to a larger one."""
    longest = max(grid.shape)
    return min(BLOCK, longest + -longest % BLOCK_MULTIPLE)


def describe(raster: Any, number: int, band: Band) -> None:
    """Write name, unit, meaning and classes of a band into an open raster; bands count from 1."""
    raster.set_band_description(number, band.name)
    raster.set_band_unit(number, band.unit)
    raster.update_tags(number, MEANING=band.meaning)
    if band.classes:
        raster.write_colormap(number, {c.value: (*c.colour, 255) for c in band.classes})
        # GDAL keeps names of classes in a side-car file, which viewers write anew.
        raster.update_tags(number, **{f"CLASS_{c.value}": f"{c.name}: {c.meaning}" for c in band.classes})
