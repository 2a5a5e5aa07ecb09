"""Limits that catalogs, stages and commands have in common."""

MIN_COVER = 0.25
"""Default share below which catalogs leave a tile out and `load` fails on it."""
LOWEST_M, HIGHEST_M = -500.0, 9000.0
"""Heights outside are nodata (m)."""
