"""Heights (the paper's R^S), road mask and height source of a tile as cloud-optimised GeoTIFF."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any
from xml.etree import ElementTree as ET

from numpy.typing import NDArray

from flexroad.catalog.crs import compound
from flexroad.catalog.grid import Grid
from flexroad.catalog.lazy import lazy
from flexroad.tasks.errors import TaskError
from flexroad.tasks.quality.height_source import HeightSource

rasterio = lazy("rasterio")

VERSION = 4
NAME_HEIGHT = "_height.tif"
NAME_ROAD = "_road.tif"
NAME_HEIGHT_SOURCE = "_height_source.tif"
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
"""Level of deflate, 1 to 9: higher levels make heights 2% smaller in up to twice the time."""


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
    """The meaning of the cells of a raster."""

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
HEIGHT_SOURCE = Band(
    "height_source",
    "Source of the surface's height",
    "uint8",
    nodata=int(HeightSource.NONE),
    classes=(
        RasterClass(HeightSource.NONE, "outside", "Beyond the survey", (255, 255, 255)),
        RasterClass(HeightSource.MEASURED, "measured", "The surface model shows the ground", (90, 160, 90)),
        RasterClass(HeightSource.DTM, "dtm", "Hidden ground: the height comes from the DTM", (240, 190, 70)),
        RasterClass(HeightSource.INFERRED, "inferred", "No height: extrapolated from around", (205, 80, 70)),
    ),
)


def encode(values: NDArray[Any], grid: Grid, band: Band, vertical: str | None = None) -> bytes:
    """Return a value in each cell of a grid, ``(H, W)``, as GeoTIFF.

    Parameters
    ----------
    values : ndarray, (H, W)
        Heights at the cell centres (m), NaN where unknown; road cells; or the cells' `HeightSource`.
    band : Band
        Their meaning: `HEIGHT`, `ROAD` or `HEIGHT_SOURCE`.
    vertical : str, optional
        Vertical CRS of heights; the file's CRS is then compound.

    Raises
    ------
    TaskError
        If the array does not have the grid's shape.
    """
    if values.shape != grid.shape:
        raise TaskError(f"{band.name} of {values.shape} cells does not fit a grid of {grid.shape}")
    # A raster of one block is not filled up to a larger block.
    longest = max(grid.shape)
    how = (
        {"overview_resampling": "mode"}
        if band.classes
        else {"predictor": 3, "overview_resampling": "average"}
    )
    profile: dict[str, Any] = {
        "driver": "COG",
        "dtype": band.dtype,
        "count": 1,
        "width": grid.width,
        "height": grid.height,
        "crs": compound(grid.crs, vertical) if vertical else grid.crs,
        "transform": grid.transform,
        "compress": "deflate",
        "level": LEVEL,
        "nodata": band.nodata,
        "blocksize": min(BLOCK, longest + -longest % BLOCK_MULTIPLE),
        **how,
    }
    with rasterio.io.MemoryFile() as file:
        with file.open(**profile) as raster:
            raster.write(values.astype(band.dtype), 1)
            describe(raster, 1, band)
        encoded: bytes = file.read()
    return encoded


def encode_style(band: Band) -> bytes:
    """Return the style of a raster of one band for QGIS, which reads it from a file of the same name.

    Classes have names and colours; the raster itself has only the colours. Heights are a hillshade.
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


def describe(raster: Any, number: int, band: Band) -> None:
    """Write name, unit, meaning and classes of a band into an open raster; bands count from 1."""
    raster.set_band_description(number, band.name)
    raster.set_band_unit(number, band.unit)
    raster.update_tags(number, MEANING=band.meaning)
    if band.classes:
        raster.write_colormap(number, {c.value: (*c.colour, 255) for c in band.classes})
        # GDAL keeps names of classes in a side-car file, which viewers overwrite.
        raster.update_tags(number, **{f"CLASS_{c.value}": f"{c.name}: {c.meaning}" for c in band.classes})
