"""Inspection of catalogs, runs, tiles and surfaces; fit of one surface in memory."""
