"""Look into catalogs, runs, tiles and surfaces; fit one surface in memory."""
