"""Headers of input files: extent, CRS, units, bands; one module per kind of data."""
