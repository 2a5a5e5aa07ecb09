"""Filters of the road mask, one file per method: ``ecsrc(data, road, options) -> RoadClusters`` (step B)."""
