"""Exports of a run for other programs: files per tile, or one file over all tiles."""
