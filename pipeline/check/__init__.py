"""Checks before a run: folders of downloads, catalogs, and why a run computes a tile."""
