"""What the header of an input file says: extent, CRS, units, bands; one file per kind of data."""
