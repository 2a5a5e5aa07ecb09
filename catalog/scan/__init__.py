"""What a folder of input files has."""
