"""Road masks: rasterise vectors, clean, compare, place, and say where the DTM counts."""
