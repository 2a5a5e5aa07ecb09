"""Roads: rasterise vectors, clean masks, align orthophotos, find invalid DTM cells, chain routes."""
