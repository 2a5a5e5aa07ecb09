"""Checks of input files before a library opens them."""
