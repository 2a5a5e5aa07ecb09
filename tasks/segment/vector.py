"""Step B of the paper, road extraction: M^r from vector areas, or from centre lines with a width."""

from __future__ import annotations

from typing import Literal

import numpy as np
from pydantic import Field

from flexroad.tasks.meshing.road_outline import encoded
from flexroad.tasks.roads import rasterise
from flexroad.tasks.roads.extent import beyond_extent
from flexroad.tasks.roads.mask_cleanup import NOTHING, Cleanup, clean
from flexroad.tasks.types import RoadMask, TileData

VERSION = 2
READS = ("roads",)
NEEDS = ("roads",)


class Options(rasterise.Options):
    """Selection of the road features, widths of the lines, and cleanup of the mask."""

    method: Literal["vector"] = "vector"
    cleanup: Cleanup = Field(NOTHING, description="cleanup of the mask; none by default")
    outlines: bool = Field(
        True,
        description="meshes have the outlines of the areas as edges, instead of steps from cell to cell; "
        "without cleanup, and with sample: {method: dynamic, mask: raw}",
    )


def segment(data: TileData, options: Options) -> RoadMask:
    """Return the cells whose centre lies on a road of the catalog's vectors, with those on bridges flagged.

    A tile that no file reaches has no road cell; a note says so.

    Raises
    ------
    TaskError
        If the vectors cannot be read.
    """
    if data.roads is None:
        note = "segment: no file of the roads layer reaches this tile, so it counts as a tile without roads"
        nowhere = np.zeros(data.grid.shape, np.bool_)
        return RoadMask(data.grid, data.core, nowhere, beyond_extent(data), bridge=nowhere, notes=(note,))
    roads = rasterise.roads(data.roads, data.grid, options)
    mask = clean(rasterise.cells(roads.areas, data.grid), data, options.cleanup)
    notes = roads.notes
    if data.lacks_road(mask):
        files = ", ".join(path.name for path in data.roads.paths)
        notes += (
            f"segment: no road of {files} lies on this tile; if there are roads, check segment.layer, "
            "segment.where and segment.left_out",
        )
    # Cleanup changes cells, which have no outline.
    outlines = options.outlines and options.cleanup == NOTHING
    return RoadMask(
        grid=data.grid,
        core=data.core,
        mask=mask,
        outside=beyond_extent(data),
        bridge=rasterise.cells(roads.areas[roads.bridge], data.grid) & mask,
        areas=encoded(roads.areas, data.core) if outlines else None,
        notes=notes,
    )
