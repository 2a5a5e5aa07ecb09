"""Road segmentation, one file or folder per method: TileData -> RoadMask, the paper's M^r."""
