"""Step B of the paper, road extraction: M^r from vector areas, or from centre lines with a width."""

from __future__ import annotations

from typing import Literal

import numpy as np
from pydantic import Field, model_validator

from flexroad.tasks.levels.abutments import levels_of
from flexroad.tasks.meshing.road_outline import encoded
from flexroad.tasks.roads import rasterise
from flexroad.tasks.types import RoadMask, TileData

VERSION = 2
LEVELS_VERSION = 2
"""A version that is raised instead of `VERSION` if results of any stage change only with `Options.levels`."""
READS = ("roads",)
NEEDS = ("roads",)


class Options(rasterise.Options):
    """Selection of the road features, and widths of the lines."""

    method: Literal["vector"] = "vector"
    outlines: bool = Field(
        True,
        description="meshes have the outlines of the areas as edges, instead of steps from cell to cell; "
        "with sample: {method: dynamic, mask: raw}",
    )
    levels: bool = Field(
        False,
        description="roads above and below roads have surfaces of their own; with ecsrc: planar, "
        "fit: smoothing_spline and load.halo_m of 40 m or more",
    )

    @model_validator(mode="after")
    def _levels_have_outlines(self) -> Options:
        if self.levels and not self.outlines:
            raise ValueError("levels need the outlines of roads; set outlines to true")
        return self


def segment(data: TileData, options: Options) -> RoadMask:
    """Return the cells whose centre lies on a road of the catalog's vectors, and mark cells on bridges.

    A tile that no file reaches has no road cell; a note says so.

    Raises
    ------
    TaskError
        If the vectors cannot be read.
    """
    if data.roads is None:
        note = "segment: no file of the roads layer reaches this tile, so it counts as a tile without roads"
        nowhere = np.zeros(data.grid.shape, np.bool_)
        return RoadMask(data.grid, data.core, nowhere, data.beyond_extent(), bridge=nowhere, notes=(note,))
    roads = rasterise.roads(data.roads, data.grid, options, options.levels)
    levels, left_out = levels_of(roads.areas, roads.shapes, roads.level, data)
    areas, bridge = roads.areas[roads.level == 0], roads.bridge[roads.level == 0]
    mask = rasterise.cells(areas, data.grid)
    notes = (*roads.notes, *left_out)
    if data.lacks_road(mask) and not levels:
        files = ", ".join(path.name for path in data.roads.paths)
        notes += (
            f"segment: no road of {files} lies on this tile; if there are roads, check segment.layer, "
            "segment.where and segment.left_out",
        )
    return RoadMask(
        grid=data.grid,
        core=data.core,
        mask=mask,
        outside=data.beyond_extent(),
        bridge=rasterise.cells(areas[bridge], data.grid),
        areas=encoded(areas, data.core) if options.outlines else None,
        notes=notes,
        levels=levels,
    )
