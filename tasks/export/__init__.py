"""Export formats, one module each: pure functions from values to bytes.

A module has `VERSION`, `NAME` (the end of the file name, after tile and variant; one constant per kind of
file), `MEDIA_TYPE`, and functions that encode values as bytes, or that write the tiles of a run to one file.
"""
