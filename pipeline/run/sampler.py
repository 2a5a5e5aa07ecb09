"""Heights, normals, classes, levels, flags and errors of finished tiles at points.

>>> from flexroad.pipeline.run.sampler import RunSampler
>>> sampler = RunSampler.open("RUN")                      # doctest: +SKIP
>>> sampler.at(eastings, northings).height                # doctest: +SKIP

Formats along roads use the spline without the steps of kerbs, walls and banks beside roads. A road along a
centre line may be wider than the road of the mask. Outside the mask it continues without a kerb.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from shapely import STRtree, box, points

from flexroad.catalog import Bounds
from flexroad.catalog.crs import same, transformer
from flexroad.catalog.storage.paths import Location
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.graph.borders import has_borders
from flexroad.pipeline.run.finished import (
    FinishedTile,
    GroundTile,
    estimate,
    flagged,
    open_variant,
    surface_and_road,
)
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.run.status import TileStatus, peek_statuses
from flexroad.tasks.levels.along_route import PlaceLevels
from flexroad.tasks.quality.flagged import UNKNOWN, Bits, passed
from flexroad.tasks.types import Bools, Floats, RoadMask, Surface

AT_ONCE = 50_000
"""Number of points whose tiles are looked up together: geometries take much memory."""

Numbers = NDArray[np.int8]
Indices = NDArray[np.intp]


LARGEST_STEP_M = 0.05
"""Largest step between tiles for formats along roads (m); tiles with common borders have no step."""
STEP_REMEDY = "use a run of production, whose tiles have common borders"
Places = slice | Bools | NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class Heights:
    """Heights of n points on each level."""

    numbers: tuple[int, ...]
    """The k levels, ascending, including 0, the ground."""
    z: Floats
    """``(k, n)``, m; NaN where a level does not exist, and beyond the surface."""
    flags: Bits | None = None
    """``(k, n)``, flags of the surface by `tasks.quality.flagged`, or None."""

    def __getitem__(self, places: Places) -> Heights:
        flags = None if self.flags is None else self.flags[:, places]
        return replace(self, z=self.z[:, places], flags=flags)

    def flags_on(self, numbers: NDArray[np.int8]) -> Bits:
        """Return the flags of the points on given levels, ``(n,)``."""
        found = np.zeros(len(numbers), np.uint16)
        if self.flags is not None:
            for number, row in zip(self.numbers, self.flags, strict=True):
                found[numbers == number] = row[numbers == number]
        return found

    @property
    def ground(self) -> Floats:
        """Heights of level 0, ``(n,)``, m."""
        return np.asarray(self.z[self.numbers.index(0)])

    @property
    def several(self) -> Bools:
        """Whether a point has another level than the ground, ``(n,)``."""
        others = [number != 0 for number in self.numbers]
        return np.asarray(np.isfinite(self.z[others]).any(axis=0))


@dataclass(frozen=True, eq=False)
class Answer:
    """Values at n points; NaN and empty strings outside the finished tiles.

    Beyond the survey, where a surface has no data, only the tile is given.
    """

    height: Floats
    """``(n,)``, m."""
    normal: Floats
    """``(n, 3)``, upward unit normals: east, north, up."""
    tile: NDArray[np.str_]
    """``(n,)``, tile ids."""
    kind: NDArray[np.str_]
    """``(n,)``, ``road`` or ``terrain`` according to the segmented mask."""
    flags: Bits
    """``(n,)``, raised flags of the cells at the points, by `tasks.quality.flagged`."""
    earlier: tuple[str, ...] = ()
    """Ids of tiles whose values are from earlier sources or options (`RunSampler.earlier`)."""
    level: NDArray[np.int8] | None = None
    """``(n,)``, numbers of the levels of the values; None if all values are on the highest level."""
    numbers: tuple[int, ...] = (0,)
    """The levels of the tiles under the points."""


def to_crs(x: Floats, y: Floats, source: str | None, target: str) -> tuple[Floats, Floats]:
    """Return coordinates in another CRS; NaN where they cannot be transformed.

    - `x`, `y` ``(n,)``: first east, then north, whatever the order of the axes of the CRS.
    - `source`: None if the points already are in the CRS ``target``.
    """
    if source is None or same(source, target):
        return x, y
    east, north = transformer(source, target).transform(x, y)
    finite = np.isfinite(east) & np.isfinite(north)
    return np.where(finite, east, math.nan), np.where(finite, north, math.nan)


def length_text(metres: float, digits: int = 0) -> str:
    """Return a length for the user, in millimetres below one metre."""
    return f"{1000 * metres:.{digits}f} mm" if metres < 1 else f"{metres:.2f} m"


class SurfaceSampler(ABC):
    """The fitted surfaces of finished tiles at points (m, in the run's CRS)."""

    @abstractmethod
    def under(self, easting: Floats, northing: Floats, free: Bools) -> Iterator[tuple[GroundTile, Indices]]:
        """Yield each tile, in the catalog's order, with the free points on it and on its edge.

        - `free` ``(n,)``: the caller sets it to False for points that need no further tile.
        """

    def at(self, easting: Floats, northing: Floats, level: int | None = None) -> Answer:
        """Return height, normal, tile and class at n points.

        A point on the edge of two finished tiles belongs to the tile that is first in the catalog. A surface
        continues beyond the survey, but its heights there are not heights of the ground.

        - `level`: 0 is the ground; other levels exist only on decks or in tunnels; None: the highest level.
        """
        easting = np.atleast_1d(np.asarray(easting, dtype=np.float64))
        northing = np.atleast_1d(np.asarray(northing, dtype=np.float64))
        height, normal = np.full(easting.shape, np.nan), np.full((*easting.shape, 3), np.nan)
        tiles, kind = np.full(easting.shape, "", dtype=object), np.full(easting.shape, "", dtype=object)
        of_level, flags = np.zeros(easting.shape, np.int8), np.zeros(easting.shape, np.uint16)
        earlier, numbers = list[str](), {0}
        for tile, surface, road, here in self._surfaces(easting, northing):
            earlier += [tile.id] if tile.earlier else []
            tiles[here] = tile.id
            here = _inside(road, easting, northing, here)
            places = easting[here], northing[here]
            top = surface.top(*places) if level is None else None
            numbers.update(surface.numbers)
            for number in surface.numbers:
                if level not in (None, number):
                    continue
                chosen = here[surface.covers(number, *places) if top is None else top == number]
                own, east, north = surface.at(number), easting[chosen], northing[chosen]
                height[chosen], normal[chosen] = own.height(east, north), own.normal(east, north)
                is_road = (number != 0) | road.mask[road.grid.cells(east, north)]
                kind[chosen], of_level[chosen] = np.where(is_road, "road", "terrain"), number
                flags[chosen] = _flags(tile, number, east, north)
        return Answer(
            height,
            normal,
            tiles.astype(str),
            kind.astype(str),
            flags,
            tuple(earlier),
            of_level if level is None else np.full(easting.shape, level, np.int8),
            tuple(sorted(numbers)),
        )

    def on_every_level(self, easting: Floats, northing: Floats) -> tuple[Indices, Answer]:
        """Return values as `at` does, a row for each level of each point, and the number of its point.

        The first row of a point is the ground; further rows are ordered by level.
        """
        ground = self.at(easting, northing, 0)
        others = [self.at(easting, northing, number) for number in ground.numbers if number != 0]
        rows = [np.arange(len(ground.height)), *(np.flatnonzero(np.isfinite(o.height)) for o in others)]
        point = np.concatenate(rows)
        order = np.argsort(point, kind="stable")

        def joined(name: str) -> Any:
            parts = zip((ground, *others), rows, strict=True)
            return np.concatenate([getattr(answer, name)[own] for answer, own in parts])[order]

        names = ("height", "normal", "tile", "kind", "flags", "level")
        return point[order], replace(ground, **{name: joined(name) for name in names})

    def heights(
        self, easting: Floats, northing: Floats, steps: bool = True
    ) -> tuple[Heights, tuple[str, ...]]:
        """Return the heights of n points on all levels, with flags, and the ids of the tiles of `earlier`.

        Heights are NaN outside the finished tiles and beyond the survey.

        - `steps`: whether level 0 has its steps beside roads; without steps it is the spline.
        """
        easting, northing = np.asarray(easting, np.float64), np.asarray(northing, np.float64)
        nothing = np.full(easting.shape, np.nan), np.zeros(easting.shape, np.uint16)
        rows, earlier = {0: nothing}, list[str]()
        for tile, surface, road, here in self._surfaces(easting, northing):
            earlier += [tile.id] if tile.earlier else []
            here = _inside(road, easting, northing, here)
            for number in surface.numbers:
                if number not in rows:
                    rows[number] = np.full(easting.shape, np.nan), np.zeros(easting.shape, np.uint16)
                own, on = surface.at(number), here[surface.covers(number, easting[here], northing[here])]
                east, north = easting[on], northing[on]
                z, bits = rows[number]
                z[on] = own.height(east, north) if steps else own.smooth(east, north)
                bits[on] = _flags(tile, number, east, north)
        numbers = tuple(sorted(rows))
        z, bits = (np.stack(each) for each in zip(*(rows[number] for number in numbers), strict=True))
        return Heights(numbers, z, bits), tuple(earlier)

    def on_road(
        self, easting: Floats, northing: Floats, levels: PlaceLevels | None = None, steps: bool = False
    ) -> Floats:
        """Return heights without steps, or the steps above them (m), at points, in their broadcast shape.

        NaN outside the tiles and beyond the survey. Where tiles meet, the first tile with a height is used.

        - `levels`: the levels of the points; where a tile does not have the level, level 0 is used, but in
          tunnels NaN. None: level 0 for all points.
        """
        easting, northing = np.broadcast_arrays(easting, northing)
        shape, levels = easting.shape, _flat(levels, easting.size)
        x, y = easting.ravel(), northing.ravel()
        values, free = np.full(x.shape, np.nan), np.ones(x.shape, np.bool_)
        for tile, surface, road, here in self._surfaces(x, y, free):
            found = on_levels(surface, x[here], y[here], levels[here], steps)
            values[here] = np.where(_beyond(tile, road, x[here], y[here]), np.nan, found)
            free[here] = np.isnan(values[here])
        return values.reshape(shape)

    def errors(self, easting: Floats, northing: Floats, numbers: Numbers) -> tuple[Floats, NDArray[np.uint8]]:
        """Return the estimated errors (m) and the `HeightSource` of n points on levels.

        They are values of the cell at each point. They are NaN and 0 outside the finished tiles, and where
        the sources of a tile have changed or are missing.
        """
        error, height_source = np.full(easting.shape, np.nan), np.zeros(easting.shape, np.uint8)
        free = np.ones(easting.shape, np.bool_)
        for tile, here in self.under(easting, northing, free):
            for number, on in _by_number(numbers, here):
                estimates = None if tile.earlier else estimate(tile, number)
                if estimates is not None:
                    cells = tile.grid.cells(easting[on], northing[on])
                    error[on], height_source[on] = (values[cells] for values in estimates)
            free[here] = height_source[here] == 0
        return error, height_source

    def flags(self, easting: Floats, northing: Floats, numbers: Numbers) -> int:
        """Return the flags that n points on given levels pass (`tasks.quality.flagged.flag_names`)."""
        bits = 0
        for tile, here in self.under(easting, northing, np.ones(easting.shape, np.bool_)):
            for number, on in _by_number(numbers, here):
                bits |= passed(_flags(tile, number, easting[on], northing[on]))
        return bits

    def tile_step(
        self,
        easting: Floats,
        northing: Floats,
        starts: Indices,
        ends: Indices,
        levels: PlaceLevels | None = None,
    ) -> float:
        """Return the largest step (m) on lines from one tile to another; 0 without such lines.

        Both surfaces are evaluated where the line leaves the first tile.

        - `starts`, `ends` ``(k,)``: numbers of the two points that a line joins.
        """
        found, owner = list[tuple[GroundTile, Surface, RoadMask]](), np.full(easting.shape, -1)
        for tile, surface, road, here in self._surfaces(easting, northing):
            owner[here] = len(found)
            found.append((tile, surface, road))
        first, last, levels = owner[starts], owner[ends], _flat(levels, easting.size)
        crossing = (first != last) & (first >= 0) & (last >= 0)
        steps, places = [0.0], np.stack([easting, northing])
        for pair in np.unique(np.stack([first, last])[:, crossing], axis=1).T.tolist():
            lines = (first == pair[0]) & (last == pair[1])
            bounds = found[pair[0]][0].grid.bounds
            x, y = _leaving(bounds, places[:, starts[lines]], places[:, ends[lines]])
            one, other = (
                np.where(_beyond(tile, road, x, y), np.nan, on_levels(surface, x, y, levels[starts[lines]]))
                for tile, surface, road in (found[number] for number in pair)
            )
            steps += np.abs(one - other).tolist()
        return float(np.nanmax(steps))

    def _surfaces(
        self, easting: Floats, northing: Floats, free: Bools | None = None
    ) -> Iterator[tuple[GroundTile, Surface, RoadMask, Indices]]:
        """Yield tiles and points as `under` does, with surface and road, if the tile still has them.

        - `free`: None: each point is given only with the first of its tiles.
        """
        left = np.ones(easting.shape, np.bool_) if free is None else free
        for tile, here in self.under(easting, northing, left):
            try:
                surface, road = surface_and_road(tile)
            except ConfigError:
                if not tile.earlier:
                    raise
                continue
            left[here] &= free is not None
            yield tile, surface, road, here


@dataclass(frozen=True, eq=False)
class TileSampler(SurfaceSampler):
    """The surfaces of some finished tiles, in a worker of an export."""

    tiles: tuple[GroundTile, ...]

    def under(self, easting: Floats, northing: Floats, free: Bools) -> Iterator[tuple[GroundTile, Indices]]:
        """Yield each tile with the free points on it; see `SurfaceSampler.under`."""
        for tile in self.tiles:
            west, south, east, north = tile.grid.bounds
            within = (west <= easting) & (easting <= east) & (south <= northing) & (northing <= north)
            here = np.flatnonzero(within & free)
            if here.size:
                yield tile, here


@dataclass(frozen=True, eq=False)
class RunSampler(SurfaceSampler):
    """The surfaces of all finished tiles of a run; only the tiles under the requested points are read.

    Surfaces are read from the store; NURBS surfaces need no source files.
    """

    run: Run
    variant: str
    earlier: bool = False
    """Whether a tile whose sources or options have changed is used with its last finished surface."""

    @classmethod
    def open(
        cls,
        path: Location | str,
        variant: str | None = None,
        allow: Sequence[str | Path] = (),
        earlier: bool = False,
    ) -> RunSampler:
        """Open a run."""
        run, variant = open_variant(path, variant, allow)
        sampler = cls(run, variant, earlier)
        if not any(map(sampler._tile, peek_statuses(run, run.catalog.tiles))):
            raise ConfigError(f"{path} has no finished tile; see `flexroad status {path}`")
        return sampler

    def under(self, easting: Floats, northing: Floats, free: Bools) -> Iterator[tuple[GroundTile, Indices]]:
        """Yield each finished tile with the free points on it; see `SurfaceSampler.under`."""
        tiles = self.run.catalog.usable
        tree = STRtree([box(*tile.grid.bounds) for tile in tiles])
        found = [np.zeros((2, 0), np.intp)]
        for at in range(0, len(easting), AT_ONCE):
            here = slice(at, at + AT_ONCE)
            pairs = tree.query(points(easting[here], northing[here]), predicate="intersects")
            found.append(pairs + np.array([[at], [0]]))
        point, number = np.hstack(found)
        if not point.size:
            return
        order = np.argsort(number, kind="stable")
        numbers, starts = np.unique(number[order], return_index=True)
        statuses = peek_statuses(self.run, [tiles[i] for i in numbers])
        for status, indices in zip(statuses, np.split(point[order], starts[1:]), strict=True):
            indices = indices[free[indices]]
            finished = self._tile(status) if indices.size else None
            if finished:
                yield finished, indices

    def largest_tile_step(self, easting: Floats, northing: Floats, near_m: float) -> float:
        """Return the largest step (m) between the tiles of neighbouring points; 0 without such tiles.

        - `near_m`: distance up to which a point and the next point belong to one line (m).
        """
        if has_borders(self.run.config.chains[self.variant]["fit"]):
            return 0.0
        near = np.hypot(np.diff(easting), np.diff(northing)) <= near_m
        return self.tile_step(easting, northing, np.flatnonzero(near), np.flatnonzero(near) + 1)

    def _tile(self, status: TileStatus) -> GroundTile | None:
        if status.done:
            return GroundTile.of(FinishedTile.of(self.run, status, self.variant))
        last = status.last_record
        if self.earlier and last is not None and last.state == "done":
            return GroundTile.of(FinishedTile.last(self.run, status, self.variant), earlier=True)
        return None


def _inside(road: RoadMask, easting: Floats, northing: Floats, selected: Indices) -> Indices:
    """Return the selected points that are not beyond the survey."""
    return selected[~road.outside[road.grid.cells(easting[selected], northing[selected])]]


def _by_number(numbers: Numbers, selected: Indices) -> Iterator[tuple[int, Indices]]:
    """Yield each level of the selected points with its points."""
    for number in np.unique(numbers[selected]).tolist():
        yield number, selected[numbers[selected] == number]


def _flags(tile: GroundTile, number: int, easting: Floats, northing: Floats) -> Bits:
    """Return the flags of the cells of a tile at points, on a level."""
    try:
        cells = flagged(tile, number)
    except ConfigError:
        if not tile.earlier:
            raise
        return np.full(easting.shape, UNKNOWN)
    return cells[tile.grid.cells(easting, northing)]


def _flat(levels: PlaceLevels | None, number: int) -> PlaceLevels:
    """Return the levels of a number of places, ``(n,)``; level 0 if they are not given."""
    if levels is None:
        return PlaceLevels(np.zeros(number, np.int8), np.ones(number, np.bool_))
    return PlaceLevels(levels.number.ravel(), levels.own.ravel())


def _beyond(tile: GroundTile, road: RoadMask, easting: Floats, northing: Floats) -> Bools:
    """Return which points on a tile are beyond the survey."""
    return road.outside[road.grid.window(road.core)][tile.grid.cells(easting, northing)]


def on_levels(
    surface: Surface, easting: Floats, northing: Floats, levels: PlaceLevels, steps: bool = False
) -> Floats:
    """Return heights of a surface without steps, or its steps (m), on the levels of points, ``(n,)``."""
    values = np.array((surface.step if steps else surface.smooth)(easting, northing))
    known = {own.level.number: own.level for own in surface.levels}
    for number in np.unique(levels.number[levels.number != 0]).tolist():
        here = levels.number == number
        if number in known:
            level, at = known[number], (easting, northing)
            # Beyond deck and approach, no data determines this surface.
            here &= levels.own | level.covers(*at) | (level.weight(*at) > 0)
            values[here] = 0.0 if steps else surface.at(number).height(easting[here], northing[here])
        elif number < 0:
            values[here & levels.own] = 0.0 if steps else np.nan
    return values


def _leaving(bounds: Bounds, start: Floats, end: Floats) -> Floats:
    """Return the points, ``(2, n)``, where lines from inside a rectangle leave it, or end."""
    along = end - start
    edges = np.where(along > 0, np.reshape(bounds[2:], (2, 1)), np.reshape(bounds[:2], (2, 1)))
    with np.errstate(divide="ignore", invalid="ignore"):
        share = np.where(along == 0, np.inf, (edges - start) / along)
    return np.asarray(start + np.clip(share.min(axis=0), 0.0, 1.0) * along)


def crs_of(sampler: RunSampler) -> str | None:
    """Return the CRS of a run, None if its tiles have several."""
    systems = {tile.grid.crs for tile in sampler.run.catalog.usable}
    return systems.pop() if len(systems) == 1 else None


def required_crs(sampler: RunSampler) -> str:
    """Return the CRS of a run."""
    crs = crs_of(sampler)
    if crs is None:
        raise ConfigError(
            f"the tiles of {sampler.run.path} have several CRSs; give points in the CRS of their tile, as a "
            "CSV with easting and northing"
        )
    return crs
