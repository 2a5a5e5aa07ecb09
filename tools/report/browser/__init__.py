"""The report as one HTML page: a map, then the tiles to look at, with closed tables."""
