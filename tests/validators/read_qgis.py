"""Print what QGIS reads of an export, as JSON: its version, heights of a raster and vertices of a layer.

Usage: read_qgis.py RASTER LINES LAYER < JSON with eastings and northings of points on the raster (m)

Run by an interpreter that has the module ``qgis``. Heights are null where the raster has none. With them come
the classes of the style beside the raster's file ``road.tif``.
"""

import json
import sys
from pathlib import Path

from qgis.core import Qgis, QgsApplication, QgsPointXY, QgsRasterLayer, QgsVectorLayer

application = QgsApplication([], False)
application.initQgis()
raster = QgsRasterLayer(sys.argv[1], "heights")
heights = []
for easting, northing in json.load(sys.stdin):
    height, known = raster.dataProvider().sample(QgsPointXY(easting, northing), 1)
    heights.append(height if known else None)
lines = QgsVectorLayer(f"{sys.argv[2]}|layername={sys.argv[3]}", "roads", "ogr")
vertices = [
    [vertex.x(), vertex.y(), vertex.z()]
    for line in lines.getFeatures()
    for vertex in line.geometry().vertices()
]
road = QgsRasterLayer(str(Path(sys.argv[1]).with_name("road.tif")), "road")
road.loadDefaultStyle()
classes = [entry.label for entry in road.renderer().classes()] if road.renderer().type() == "paletted" else []
json.dump(
    {
        "version": Qgis.QGIS_VERSION.split("-")[0],
        "crs": raster.crs().authid(),
        "heights": heights,
        "vertices": vertices,
        "classes": classes,
    },
    sys.stdout,
)
