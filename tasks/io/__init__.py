"""Readers of rasters, orthophotos and vector files for one tile."""
