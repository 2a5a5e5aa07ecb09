"""Centre lines of four streets of the Barbican, London (EPSG:27700)."""

STREETS = {
    "Aldersgate Street": [
        (532096, 181949),
        (532103, 181881),
        (532110, 181813),
        (532119, 181745),
        (532131, 181677),
        (532135, 181625),
    ],
    "London Wall": [(532405, 181569), (532453, 181574), (532509, 181576), (532566, 181574), (532640, 181572)],
    "Moor Lane": [(532583, 181796), (532566, 181733), (532552, 181688), (532538, 181637), (532526, 181591)],
    "Wood Street": [(532308, 181370), (532328, 181438), (532351, 181506), (532368, 181540)],
}
"""Drawn by hand on the land cover; no data set of centre lines comes with the rasters."""
