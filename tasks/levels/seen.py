"""The heights of a tile that each level uses ("sees"): levels differ in nothing else.

Level 0 does not see the decks. It does not see the approaches either, where it has the surface of their
level. A deck sees itself and its approaches, and more than 12 m away from them all that level 0 sees. A
tunnel sees its approaches; its own heights are inferred from them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import scipy
import shapely

from flexroad.catalog.grid import Grid
from flexroad.tasks.meshing.road_outline import encoded
from flexroad.tasks.roads import rasterise
from flexroad.tasks.roads.distances import within
from flexroad.tasks.roads.dtm_validity import DSM_DTM_TOLERANCE_M
from flexroad.tasks.types import Bools, Floats, Level, RoadClusters, RoadMask, TileData

HIDDEN_M = 1.0
"""Distance beside a deck up to which the DSM shows neither level (m)."""
APART_M = 12.0
"""Heights of level 0 this near to a deck (m) are left out: a control point acts up to 10.8 m away."""
MOST = 400
"""Largest number of cells of the approaches from which the heights of a tunnel are inferred."""
LEAST = 20
"""Smallest number of cells from which they are inferred."""
SMOOTHING = 10.0
"""Smoothing of the thin plate through these cells."""

Filter = Callable[[TileData, RoadMask, bool], RoadClusters]
"""The filter of one level; its last argument says whether the level is another than 0."""


def level_data(data: TileData, clusters: RoadClusters, number: int = 0) -> TileData:
    """Return the heights that a level sees; the data itself if the tile has no levels.

    - `clusters`: the clusters of level 0, with the other levels.
    """
    if not clusters.levels:
        return data
    levels = tuple(own.level for own in clusters.levels if own.level)
    result = _masked(data, levels, number)
    own = next((own for own in clusters.levels if own.number == number), None)
    if own is None or own.level is None or number > 0:
        return result
    return replace(result, dsm=_inferred(result, own.level, own.mask & np.isfinite(result.dsm)))


def level_clusters(
    data: TileData, road: RoadMask, ecsrc: Filter, shoulder_m: float, beyond_m: float
) -> RoadClusters:
    """Return the filtered roads of level 0, with the filtered roads of the other levels.

    - `ecsrc`: the filter of one level.
    - `shoulder_m`, `beyond_m`: width of the shoulder, and distance beyond it, up to which the ground beside
      roads has steps (m).
    """
    grid, levels = data.grid, road.levels
    approach = _any(grid, [_taken(level, grid) for level in levels])
    below = _hidden(levels, grid) & road.mask
    own = ecsrc(_masked(data, levels, 0), road, False)
    # A road below a deck continues between its visible parts, as stiff as a road. The DTM there is
    # interpolated, also from walls. Ground that is near enough to act on the road gets its height by steps.
    shoulder = within(below, grid.cell, APART_M) & ~road.mask
    labels = np.where(below, max(1, int(own.labels.max())), own.labels)
    own = _without(replace(own, labels=labels.astype(np.int32)), approach)
    own = replace(own, dtm_invalid=shoulder | (own.dtm_invalid if own.dtm_invalid is not None else False))
    if own.beside is not None:
        reach = shoulder_m + beyond_m
        near = _any(grid, [_cells(shapely.buffer(deck.areas, reach), grid) for deck in _decks(levels)])
        near |= within(shoulder, grid.cell, beyond_m)
        own = replace(own, beside=own.beside | near & ~road.mask)
    return replace(own, levels=tuple(_of_level(data, road, level, ecsrc) for level in levels))


def with_approaches(clusters: RoadClusters) -> RoadClusters:
    """Return the clusters of level 0 together with the clusters of its approaches, from other levels."""
    for own in clusters.levels:
        assert own.level
        taken = _taken(own.level, clusters.grid)
        labels = np.where(taken, own.labels, clusters.labels)
        invalid = clusters.dtm_invalid
        if invalid is not None and own.dtm_invalid is not None:
            invalid = np.where(taken, own.dtm_invalid, invalid)
        clusters = replace(clusters, labels=labels, dtm_invalid=invalid)
    return clusters


def top_mask(clusters: RoadClusters) -> Bools:
    """Return the filtered road cells of the highest level, ``(H, W)``."""
    result = with_approaches(clusters).mask
    for own in clusters.levels:
        if own.level and own.level.number > 0:
            result = np.where(_own(own.level, clusters.grid), own.mask, result)
    return result


def hidden(levels: tuple[Level, ...], number: int, grid: Grid) -> Bools:
    """Return the cells of a level below decks and beside decks, ``(H, W)``: the decks hide them."""
    if number == 0:
        return _hidden(levels, grid)
    level = next(level for level in levels if level.number == number)
    above = [other for other in levels if other.number > max(number, 0)]
    return _any(grid, [_over(deck, grid) & ~(_approach(deck, grid) & _own(level, grid)) for deck in above])


def off_ground(levels: tuple[Level, ...], grid: Grid) -> Bools:
    """Return the cells of level 0 below and beside decks, and above tunnels, ``(H, W)``."""
    return _any(grid, [_hidden(levels, grid), *(_own(level, grid) for level in levels if level.number < 0)])


def level_road(road: RoadMask, number: int) -> RoadMask:
    """Return the road mask of a level; for levels other than 0 their areas, which limit their mesh."""
    if number == 0:
        return road
    level = next(level for level in road.levels if level.number == number)
    mask = _own(level, road.grid)
    areas = encoded(np.array([level.areas]), road.core)
    return RoadMask(road.grid, road.core, mask, ~mask, areas=areas, levels=road.levels)


def _of_level(data: TileData, road: RoadMask, level: Level, ecsrc: Filter) -> RoadClusters:
    grid = data.grid
    own, approach = _own(level, grid), _taken(level, grid)
    apart = _cells(shapely.buffer(level.areas, APART_M), grid) & ~own & ~approach
    mask = road.mask & ~apart | own | approach
    clusters = ecsrc(_masked(data, road.levels, level.number), replace(road, mask=mask, levels=()), True)
    if level.number < 0:
        labels = np.where(own, max(1, int(clusters.labels.max())), clusters.labels)
        clusters = replace(clusters, labels=labels.astype(np.int32))
    if data.decks is not None and level.number > 0 and clusters.dtm_invalid is not None:
        # The layer of decks has their height, even where it differs from the slope of the approaches.
        valid = own & np.isfinite(data.decks)
        clusters = replace(clusters, dtm_invalid=clusters.dtm_invalid & ~valid)
    return replace(_without(clusters, apart), beside=None, level=level)


def _masked(data: TileData, levels: tuple[Level, ...], number: int) -> TileData:
    """Return the data without the heights that a level does not see."""
    grid = data.grid
    below = _hidden(levels, grid)
    if number == 0:
        dsm = np.where(below, np.nan, data.dsm)
        # If a terrain model shows the deck, it does not show the ground below it.
        dtm = np.where(below & (np.abs(data.dtm - data.dsm) <= DSM_DTM_TOLERANCE_M), np.nan, data.dtm)
        return _replaced(data, dsm, dtm)
    level = next(level for level in levels if level.number == number)
    own = _own(level, grid)
    gone = below & ~own | hidden(levels, number, grid)
    if number < 0:
        gone |= own
    known = np.nan if data.decks is None or number < 0 else data.decks
    return _replaced(data, np.where(gone, np.nan, data.dsm), np.where(own, known, data.dtm))


def _replaced(data: TileData, dsm: Floats, dtm: Floats) -> TileData:
    height = data.road_height
    if height is not None:
        height = np.where(np.isnan(dsm) & ~np.isnan(data.dsm), np.nan, height)
    return replace(data, dsm=dsm, dtm=dtm, road_height=height)


def _inferred(data: TileData, level: Level, visible: Bools) -> Floats:
    """Return the DSM with the heights of a tunnel: a thin plate through its approaches."""
    grid, own = data.grid, _own(level, data.grid)
    # Other roads near the portals may lie above the tunnel.
    row, col = np.nonzero(visible & _taken(level, grid))
    if len(row) < LEAST or not own.any():
        return data.dsm
    chosen = np.linspace(0, len(row) - 1, min(len(row), MOST)).astype(int)
    row, col = row[chosen], col[chosen]
    x, y = grid.eastings - grid.west, grid.northings - grid.south
    plate = scipy.interpolate.RBFInterpolator(
        np.column_stack([x[col], y[row]]), data.dsm[row, col], kernel="thin_plate_spline", smoothing=SMOOTHING
    )
    result, (i, j) = data.dsm.copy(), np.nonzero(own)
    result[i, j] = plate(np.column_stack([x[j], y[i]]))
    return result


def _without(clusters: RoadClusters, cells: Bools) -> RoadClusters:
    """Return clusters in which some cells have neither a road nor a valid DTM."""
    invalid = cells if clusters.dtm_invalid is None else clusters.dtm_invalid | cells
    labels = np.where(cells, 0, clusters.labels).astype(np.int32)
    return replace(clusters, labels=labels, dtm_invalid=invalid)


def _hidden(levels: tuple[Level, ...], grid: Grid) -> Bools:
    """Return the cells on decks and beside them, except approaches."""
    approach = _any(grid, [_taken(level, grid) for level in levels])
    return _any(grid, [_over(deck, grid) for deck in _decks(levels)]) & ~approach


def _decks(levels: tuple[Level, ...]) -> list[Level]:
    return [level for level in levels if level.number > 0]


def _any(grid: Grid, masks: list[Bools]) -> Bools:
    return np.asarray(np.logical_or.reduce([np.zeros(grid.shape, np.bool_), *masks]))


def _own(level: Level, grid: Grid) -> Bools:
    """Return the cells of the decks or tunnels."""
    return _once(level, grid, "own", lambda: _cells(level.areas, grid))


def _over(deck: Level, grid: Grid) -> Bools:
    """Return the cells on decks and beside them."""
    return _once(deck, grid, "over", lambda: _cells(shapely.buffer(deck.areas, HIDDEN_M), grid))


def _approach(level: Level, grid: Grid) -> Bools:
    return _once(level, grid, "approach", lambda: _cells(level.approach, grid))


def _taken(level: Level, grid: Grid) -> Bools:
    """Return the cells of the approach, on which level 0 has the surface of another level."""

    def make() -> Bools:
        result = _approach(level, grid)
        row, col = np.nonzero(result)
        result[row, col] = level.weight(grid.eastings[col], grid.northings[row]) >= 1
        return result

    return _once(level, grid, "taken", make)


def _once(level: Level, grid: Grid, name: str, make: Callable[[], Bools]) -> Bools:
    """Return a raster of a level, ``(H, W)``; it is made once and kept with the level.

    Empty rows and columns around it are not kept, because a tile has many cells and a deck few.
    """
    key, result = (name, grid), np.zeros(grid.shape, np.bool_)
    if key not in level.rasters:
        cells = make()
        rows, cols = (np.flatnonzero(cells.any(axis)) for axis in (1, 0))
        window = tuple(slice(side[0], side[-1] + 1) if side.size else slice(0) for side in (rows, cols))
        level.rasters[key] = window, cells[window].copy()
    window, part = level.rasters[key]
    result[window] = part
    return result


def _cells(area: shapely.Geometry, grid: Grid) -> Bools:
    return rasterise.cells(np.array([area]), grid)
