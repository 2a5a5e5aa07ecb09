"""The computation of corners and edges of tiles.

Each corner and edge is computed like a small tile, which all tiles around it share::

    Border -> load_border -> segment -> ecsrc -> corner | edge -> the tile's fit

If the module of a fit has the functions `corner` and `edge`, the fit keeps the control points from them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from flexroad.catalog import Grid, Tile
from flexroad.catalog.borders import Border, border_of
from flexroad.catalog.tile import REACH_M
from flexroad.tasks.errors import LayerMissing
from flexroad.tasks.load import READS, load_border
from flexroad.tasks.load import Options as LoadOptions
from flexroad.tasks.options import Options, stage_function, stage_module
from flexroad.tasks.roads.dtm_validity import Slices
from flexroad.tasks.spline.frame import Corner, Edge, Frame
from flexroad.tasks.types import RoadClusters, RoadMask, TileData

AROUND_M = 100.0
"""Distance from a corner or edge up to which the filter reads the ground (m). The filter judges a road by the
size of its cluster, so a short piece of a viaduct would look like an object. A larger halo replaces it, and
so does a larger acting distance of the control points: without ground there, the mesh must not depend on
them."""
ENDS = ((0, 1), (2, 3), (0, 2), (1, 3))
"""Numbers of the corners at the ends of the southern, northern, western and eastern edge."""


@dataclass(frozen=True)
class BorderStages:
    """The stages that compute a corner or edge, with their options."""

    segment: Options
    ecsrc: Options
    fit: Options
    load: LoadOptions
    """The heights to which roads are fitted, and the halo of the tiles: if the halo reaches the far side of a
    void, the corner or edge must reach it, too."""

    @classmethod
    def of(cls, chain: Mapping[str, Options]) -> BorderStages:
        """Return the stages of a variant."""
        load = chain["load"]
        assert isinstance(load, LoadOptions)
        return cls(chain["segment"], chain["ecsrc"], chain["fit"], load)

    @property
    def heights(self) -> list[Any]:
        """The options of `load` on which the ground depends, for fingerprints."""
        return [self.load.road_height, self.load.offset_undeclared]

    @property
    def by_name(self) -> dict[str, Options]:
        """The options by stage."""
        return {"segment": self.segment, "ecsrc": self.ecsrc, "fit": self.fit}

    @property
    def reads(self) -> frozenset[str]:
        """Names of the layers that they read."""
        return frozenset((*READS, *getattr(stage_module(self.segment), "READS", ())))

    @property
    def reach_m(self) -> float:
        """Distance from a corner or edge up to which ground is read (m), at most `REACH_M`."""
        fit: Any = stage_module(self.fit)
        acting_m: float = fit.acting_m(self.fit)
        return min(max(AROUND_M, self.load.halo_m, acting_m), REACH_M)

    def part(self, border: Border, data: TileData, ends: Sequence[Corner]) -> Corner | Edge:
        """Return the control points of a corner, or of an edge between its two ends.

        - `data`: the rasters around it, from `load_border`.
        """
        road = self._segmented(data)
        module: Any = stage_module(self.fit)
        clusters = self._filtered(data, road, module.near(border, self.fit))
        if not module.is_near(data, clusters, border, self.fit):
            clusters = self._filtered(data, road, None)
        if border.kind == "corner":
            corner: Corner = module.corner(data, road, clusters, border, self.fit)
            return corner
        edge: Edge = module.edge(data, road, clusters, border, ends, self.fit)
        return edge

    def frame(self, data: TileData, tile: Grid) -> Frame:
        """Return the frame of a tile from rasters that reach `reach_m` beyond it."""
        parts: list[Any] = []
        for number, border in enumerate(border_of(tile, self.reach_m)):
            ends = [parts[end] for end in ENDS[number - 4]] if number >= 4 else []
            parts.append(self.part(border, _cut(data, border.grid), ends))
        return Frame(*parts)

    def _filtered(self, data: TileData, road: RoadMask, near: Slices | None) -> RoadClusters:
        """Return the filtered roads; with ``near``, arrays only for the fit are computed only there."""
        of_part = getattr(stage_module(self.ecsrc), "ecsrc_near", None)
        clusters: RoadClusters = (
            of_part(data, road, self.ecsrc, near)
            if of_part and near
            else stage_function("ecsrc", self.ecsrc)(data, road, self.ecsrc)
        )
        return clusters

    def _segmented(self, data: TileData) -> RoadMask:
        try:
            road: RoadMask = stage_function("segment", self.segment)(data, self.segment)
        except LayerMissing:
            nowhere = np.zeros(data.grid.shape, np.bool_)
            road = RoadMask(data.grid, data.core, nowhere, data.beyond_extent())
        return road


def _cut(data: TileData, grid: Grid) -> TileData:
    """Return the data of a corner or edge, a part of larger rasters."""
    part = data.grid.window(grid)
    return TileData(
        tile_id=data.tile_id,
        grid=grid,
        core=grid,
        dsm=data.dsm[part],
        dtm=data.dtm[part],
        road_height=None if data.road_height is None else data.road_height[part],
        offset_dsm=data.offset_dsm,
        road_mask=None if data.road_mask is None else data.road_mask[part],
        roads=data.roads,
        decks=None if data.decks is None else data.decks[part],
    )


@dataclass(frozen=True)
class BorderTask:
    """The computation of one corner or edge."""

    border: Border
    stages: BorderStages

    def ground(self, tile: Tile) -> Tile:
        """Return the ground around it, with the files of a tile that the stages read there."""
        return tile.around(self.border.grid, self.border.within(REACH_M), self.stages.reads)

    def __call__(self, tile: Tile, ends: Sequence[Corner]) -> Corner | Edge:
        """Return the control points of the corner, or of the edge between its two ends."""
        data = load_border(self.ground(tile), tile.grid, self.stages.load)
        return self.stages.part(self.border, data, ends)
