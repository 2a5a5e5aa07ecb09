"""Step B of the paper, road extraction: M^r from an existing mask layer."""

from __future__ import annotations

from typing import Literal

import numpy as np

from flexroad.tasks import options
from flexroad.tasks.types import RoadMask, TileData

VERSION = 1
NEEDS = ("road_mask",)
"""Layers without which a tile fails, in every segmentation method."""


class Options(options.Options):
    """Use the catalog's road mask; there are no options."""

    method: Literal["mask"] = "mask"


def segment(data: TileData, options: Options) -> RoadMask:
    """Return the road cells of the catalog's mask layer.

    A tile that no mask reaches has no road cell; a note says so.
    """
    mask = np.zeros(data.grid.shape, np.bool_) if data.road_mask is None else data.road_mask
    note = None
    if data.road_mask is None:
        note = "segment: no road mask reaches this tile, so it counts as a tile without roads"
    elif data.lacks_road(mask):
        note = (
            "segment: the road mask has no road cell on this tile; if there are roads, give the values that "
            "mean road with --road-value of `flexroad catalog rasters`"
        )
    return RoadMask(data.grid, data.core, mask, data.beyond_extent(), notes=(note,) if note else ())
