"""Synthetic crossings as data of tiles: roads on decks and in tunnels, with the true height of each level."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.ndimage import distance_transform_edt

from flexroad.catalog import Grid
from flexroad.catalog.borders import border_of
from flexroad.tasks import load
from flexroad.tasks.border import ENDS, BorderStages
from flexroad.tasks.filter import planar
from flexroad.tasks.fit import smoothing_spline
from flexroad.tasks.segment import vector
from flexroad.tasks.spline.frame import Frame
from flexroad.tasks.types import RoadClusters, RoadMask, Source, Surface, TileData
from flexroad.tools.synthetic.crossings import (
    CROSS_M,
    MAIN_M,
    REACH_M,
    CrossingOptions,
    Crossings,
    make_crossings,
)
from flexroad.tools.synthetic.scene import CentreLine
from flexroad.tools.synthetic.scenes import _write_lines

AROUND_M, HALO_M = 100.0, 50.0
CRS = "EPSG:25832"
STEEP = 1.0
"""Slope of the ground above which a cell lies on a wall."""


Change = Callable[[list[CentreLine]], list[CentreLine]]


@dataclass(frozen=True, eq=False)
class Result:
    """The results of the stages of one tile."""

    data: TileData
    road: RoadMask
    clusters: RoadClusters
    surface: Surface


@dataclass(frozen=True, eq=False)
class Survey:
    """The data of an area with a crossing, and what is true there."""

    world: Crossings
    data: TileData
    parts: dict[Any, Any] = field(default_factory=dict)
    """The corners and edges of its tiles."""

    @classmethod
    def of(cls, folder: Path, seed: int, core: Grid, change: Change = list, **options) -> Survey:
        """Return the survey of a tile and of `AROUND_M` around it, with changed centre lines of its roads."""
        grid, world = core.buffered(AROUND_M), Crossings(seed, CrossingOptions(**options))
        scene = make_crossings(grid, seed, world.options)
        path = folder / f"roads{seed}.gpkg"
        _write_lines(path, change(world.roads(grid.bounds)), CRS)
        roads = Source("roads", (path,))
        return cls(world, TileData("a", grid, grid, scene.dsm, scene.dtm, roads=roads))

    def tile(self, core: Grid, levels: bool = True) -> Result:
        """Return the results of a tile, with the corners and edges that it shares with its neighbours."""
        segment = vector.Options(levels=levels)
        chain = {
            "load": load.Options(halo_m=HALO_M),
            "segment": segment,
            "ecsrc": planar.Options(shoulder_m=5),
            "fit": smoothing_spline.Options(),
        }
        parts: list[Any] = []
        for number, border in enumerate(border_of(core, AROUND_M)):
            key = border.kind, border.start, border.tile, levels
            if key not in self.parts:
                ends = [parts[end] for end in ENDS[number - 4]] if number >= 4 else []
                self.parts[key] = BorderStages.of(chain).part(border, self._cut(border.grid), ends)
            parts.append(self.parts[key])
        frame = Frame(*parts)
        data = replace(self._cut(core.buffered(HALO_M)), core=core)
        road = vector.segment(data, segment)
        clusters = planar.ecsrc(data, road, chain["ecsrc"])
        return Result(data, road, clusters, smoothing_spline.fit(data, clusters, chain["fit"], frame))

    def _cut(self, grid: Grid) -> TileData:
        window = self.data.grid.window(grid)
        dsm, dtm = self.data.dsm[window], self.data.dtm[window]
        decks = None if self.data.decks is None else self.data.decks[window]
        return TileData("a", grid, grid, dsm, dtm, roads=self.data.roads, decks=decks)

    def classes(self, core: Grid) -> dict[str, np.ndarray]:
        """Return the cells of a tile by class: deck, tunnel, under, near, beside, approach, other.

        Cells on the faces of walls, where one has metres of height, are not beside.
        """
        x, y = np.meshgrid(core.eastings, core.northings)
        s, v = self.world._along(x, y)
        level = np.where(np.isfinite(self.world.height(1, x, y)), 1, 0)
        level -= np.isfinite(self.world.height(-1, x, y))
        cross, ends = np.zeros(x.shape, bool), np.full(x.shape, np.inf)
        for crossing, near in self.world._near(s):
            t, u = crossing.across(s, v)
            cross |= near & (np.abs(u) <= CROSS_M) & (np.abs(t) <= REACH_M)
            ends = np.where(near, np.abs(s - crossing.along) - crossing.half_length_m, ends)
        away = distance_transform_edt(level == 0) * core.cell
        main = np.abs(v) <= MAIN_M
        steep = np.hypot(*np.gradient(self.world.height(0, x, y), core.cell)) > STEEP
        return {
            "deck": (level == 1) & main,
            "tunnel": (level == -1) & main,
            "under": (level == 1) & cross,
            "near": (level == 0) & cross & (away <= 6) & ~main,
            "beside": ~steep & (away > 1.5) & (away <= 6) & ~cross & (np.abs(v) > 6.5),
            "approach": (level == 0) & main & (ends > 0) & (ends <= 10),
            "other": (level == 0) & ((main & (ends > 25)) | (cross & (away > 25))),
        }

    def errors(self, result: Result) -> dict[str, float]:
        """Return the mean error of each class (m) that has cells."""
        core = result.data.core
        x, y = np.meshgrid(core.eastings, core.northings)
        errors = {}
        for name, cells in self.classes(core).items():
            if not cells.any():
                continue
            number = {"deck": 1, "tunnel": -1}.get(name, 0)
            # Without levels there is one surface.
            own = result.surface.at(number) if number and result.road.levels else result.surface
            height = own.height(x, y)
            if name == "approach" and result.road.levels:
                # Of a deck that is drawn too long, the end is an approach.
                height = result.surface.highest.lattice(core.eastings, core.northings)
            off = height - self.world.height(number, x, y)
            errors[name] = float(np.abs(off[cells]).mean())
        return errors


def block(size_m: int, cell: float = 1.0) -> Grid:
    """Return a tile in whose middle the first crossing lies."""
    n = round(size_m / cell)
    return Grid(CRS, 499_990.0, 5_599_990.0 + size_m, cell, n, n)
