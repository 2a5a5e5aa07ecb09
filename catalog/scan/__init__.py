"""The contents of a folder of input files."""
