from xml.etree import ElementTree as ET

import pytest

from flexroad.tasks.export import cog, qgis_style


@pytest.mark.parametrize("band", [cog.ROAD, cog.SUPPORT], ids=["road", "support"])
def test_encode_classes_have_the_names_and_colours_of_the_raster(band):
    renderer = ET.fromstring(qgis_style.encode(band)).find("pipe/rasterrenderer")
    assert (renderer.attrib["type"], renderer.attrib["band"]) == ("paletted", "1")
    entries = [
        (int(entry.attrib["value"]), entry.attrib["label"], bytes.fromhex(entry.attrib["color"][1:]))
        for entry in renderer.iter("paletteEntry")
    ]
    # Nodata is transparent.
    assert entries == [(c.value, c.meaning, bytes(c.colour)) for c in band.classes if c.value != band.nodata]


def test_encode_heights_are_hillshade():
    renderer = ET.fromstring(qgis_style.encode(cog.HEIGHT)).find("pipe/rasterrenderer")
    assert renderer.attrib["type"] == "hillshade"
    assert len(renderer) == 0
