"""The look of a raster in QGIS: a style file, which it reads from beside a file of the same name.

Classes have their names and colours, of which the raster has the colours alone. Heights are a hillshade.
"""

from __future__ import annotations

from xml.etree import ElementTree as ET

from flexroad.tasks.export.cog import Band

NAME = ".qml"
DOCTYPE = b"<!DOCTYPE qgis PUBLIC 'http://mrcc.com/qgis.dtd' 'SYSTEM'>\n"
HILLSHADE = {"type": "hillshade", "azimuth": "315", "angle": "45", "zfactor": "1", "multidirection": "0"}
SHARED = {"band": "1", "opacity": "1", "alphaBand": "-1"}


def encode(band: Band) -> bytes:
    """Return the style of a raster of one band: its classes, or hillshade if it has none."""
    style = ET.Element("qgis", {"version": "3.28.0", "styleCategories": "Symbology"})
    pipe = ET.SubElement(style, "pipe")
    kind = {"type": "paletted"} if band.classes else HILLSHADE
    renderer = ET.SubElement(pipe, "rasterrenderer", kind | SHARED)
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
    return DOCTYPE + text + b"\n"
