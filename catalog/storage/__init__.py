"""Locations of files on disk and in object storage, and atomic writes."""
