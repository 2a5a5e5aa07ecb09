"""Algorithms that the filters share."""
