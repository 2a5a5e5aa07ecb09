"""Files of a finished tile: encoders of meshes, rasters and surfaces."""
