"""Triangulation of a tile in plan, with edges along given lines."""
