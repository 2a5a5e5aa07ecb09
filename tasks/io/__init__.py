"""Read rasters, orthophotos and vector files of one tile."""
