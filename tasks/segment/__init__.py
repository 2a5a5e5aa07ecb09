"""One file per method of finding the road: TileData -> RoadMask, the paper's M^r."""
