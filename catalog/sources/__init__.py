"""Sources of tiles: one module per kind of input folder."""
