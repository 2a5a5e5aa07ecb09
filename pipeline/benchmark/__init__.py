"""Synthetic surveys with known truth, written as rasters and a catalog."""
