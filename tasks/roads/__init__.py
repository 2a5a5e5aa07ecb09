"""Road masks: rasterise vectors, clean and compare masks, align orthophotos, find invalid DTM cells."""
