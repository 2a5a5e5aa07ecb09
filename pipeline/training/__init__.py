"""Train a segmenter on the tiles of a catalog, and judge it on tiles kept apart."""
