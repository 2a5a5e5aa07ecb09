"""Look into catalogs, tiles and surfaces."""
