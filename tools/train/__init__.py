"""Train a segmenter on tiles of a catalog and validate it on separate tiles."""
