"""Heights, normals, tiles and classes of a run at points.

>>> from flexroad.pipeline.run.points import Ground
>>> ground = Ground.open("RUN")                       # doctest: +SKIP
>>> ground.at(eastings, northings).height             # doctest: +SKIP
"""

from __future__ import annotations

import math
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
    RunPlace,
    estimate,
    flagged,
    open_variant,
)
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.run.status import TileStatus, peek_statuses
from flexroad.pipeline.run.tile_steps import largest_tile_step
from flexroad.tasks.quality.flagged import UNKNOWN, Bits
from flexroad.tasks.spline.levelled import LevelledSurface
from flexroad.tasks.spline.stepped import SteppedSurface
from flexroad.tasks.types import Bools, Floats, RoadMask, Surface

Places = slice | Bools | NDArray[np.intp]

AT_ONCE = 50_000
"""Number of points of which the tiles are looked up together: geometries take much memory."""


@dataclass(frozen=True, eq=False)
class Heights:
    """Heights of n points on each level."""

    numbers: tuple[int, ...]
    """The k levels, ascending; 0, the ground, is one of them."""
    z: Floats
    """``(k, n)``, m; NaN where a level is not, and beyond the surface."""
    flags: Bits | None = None
    """``(k, n)``, flags of the surface by `tasks.quality.flagged`; None if it has none."""

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
    """Values at n points; NaN and empty strings off the finished tiles.

    Beyond the survey, where a surface is but has no data, only the tile is given.
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
    """Ids of tiles whose values are of earlier sources or options (`Ground.earlier`)."""
    level: NDArray[np.int8] | None = None
    """``(n,)``, numbers of the levels that the values are of; None if all are of the highest."""
    numbers: tuple[int, ...] = (0,)
    """The levels of the tiles that have points."""


@dataclass(frozen=True, eq=False)
class Ground:
    """The fitted surfaces of a run's finished tiles.

    Surfaces are read from the store; NURBS surfaces need no source files. Only the tiles under the requested
    points are read.
    """

    run: Run
    variant: str
    earlier: bool = False
    """Whether a tile of which sources or options have changed since has its last finished surface."""

    @classmethod
    def open(
        cls,
        path: Location | str,
        variant: str | None = None,
        allow: Sequence[str | Path] = (),
        earlier: bool = False,
    ) -> Ground:
        """Open a run."""
        run, variant = open_variant(path, variant, allow)
        ground = cls(run, variant, earlier)
        if not any(map(ground._finished, peek_statuses(run, run.catalog.tiles))):
            raise ConfigError(f"{path} has no finished tile; see `flexroad status {path}`")
        return ground

    def at(self, easting: Floats, northing: Floats, level: int | None = None) -> Answer:
        """Return height, normal, tile and class at n points (m, in the run's CRS).

        A point on the edge of two finished tiles belongs to the one first in the catalog. A surface goes on
        beyond the survey, but its heights there are no heights of the ground.

        - `level`: the level of roads above roads: 0 is the ground, others are where they have decks or tubes.
          None: the highest at each point.
        """
        easting = np.atleast_1d(np.asarray(easting, dtype=np.float64))
        northing = np.atleast_1d(np.asarray(northing, dtype=np.float64))
        height = np.full(easting.shape, np.nan)
        normal = np.full((*easting.shape, 3), np.nan)
        tile = np.zeros(easting.shape, dtype=object)
        kind = np.full(easting.shape, "", dtype=object)
        tile[:] = ""
        earlier, numbers = [], {0}
        of_level, flags = np.zeros(easting.shape, np.int8), np.zeros(easting.shape, np.uint16)
        for status, surface, road, selected in self._surfaces(easting, northing):
            earlier += [] if status.done else [status.graph.tile.id]
            tile[selected] = status.graph.tile.id
            selected = _inside(road, easting, northing, selected)
            numbers.update(surface.numbers if isinstance(surface, LevelledSurface) else ())
            for number, chosen, own in _by_level(surface, easting, northing, selected, level):
                east, north = easting[chosen], northing[chosen]
                height[chosen], normal[chosen] = own.height(east, north), own.normal(east, north)
                is_road = (number != 0) | road.mask[road.grid.cells(east, north)]
                kind[chosen], of_level[chosen] = np.where(is_road, "road", "terrain"), number
                flags[chosen] = self._flags(status, number, east, north)
        return Answer(
            height,
            normal,
            tile.astype(str),
            kind.astype(str),
            flags,
            tuple(earlier),
            of_level if level is None else np.full(easting.shape, level, np.int8),
            tuple(sorted(numbers)),
        )

    def heights(
        self, easting: Floats, northing: Floats, steps: bool = True
    ) -> tuple[Heights, tuple[str, ...]]:
        """Return the heights of n points on all levels, with flags, and the ids of the tiles of `earlier`.

        Heights are NaN off the finished tiles and beyond the survey.

        - `steps`: whether level 0 has its steps beside roads; without them it is the spline.
        """
        easting, northing = np.asarray(easting, np.float64), np.asarray(northing, np.float64)
        rows, earlier = {0: np.full(easting.shape, np.nan)}, list[str]()
        flags = {0: np.zeros(easting.shape, np.uint16)}
        for status, surface, road, selected in self._surfaces(easting, northing):
            earlier += [] if status.done else [status.graph.tile.id]
            here = _inside(road, easting, northing, selected)
            east, north = easting[here], northing[here]
            if isinstance(surface, SteppedSurface) and not steps:
                rows[0][here] = surface.smooth(east, north)
            else:
                rows[0][here] = surface.height(east, north)
            flags[0][here] = self._flags(status, 0, east, north)
            if isinstance(surface, LevelledSurface):
                for own in surface.levels:
                    row = rows.setdefault(own.level.number, np.full(easting.shape, np.nan))
                    on = own.level.covers(east, north)
                    row[here[on]] = surface.at(own.level.number).height(east[on], north[on])
                    bits = flags.setdefault(own.level.number, np.zeros(easting.shape, np.uint16))
                    bits[here[on]] = self._flags(status, own.level.number, east[on], north[on])
        numbers = tuple(sorted(rows))
        z, bits = (np.stack([each[number] for number in numbers]) for each in (rows, flags))
        return Heights(numbers, z, bits), tuple(earlier)

    def largest_tile_step(self, easting: Floats, northing: Floats, near_m: float) -> float:
        """Return the largest step (m) between the tiles of neighbouring points, ``(n,)``; 0 if there is none.

        - `near_m`: distance up to which a point and the next one belong to one line (m).
        """
        if has_borders(self.run.config.chains[self.variant]["fit"]):
            return 0.0
        tiles, surfaces = np.full(easting.shape, -1), list[tuple[Bounds, Surface]]()
        for status, surface, road, selected in self._surfaces(easting, northing):
            tiles[_inside(road, easting, northing, selected)] = len(surfaces)
            surfaces.append((status.graph.tile.grid.bounds, surface))
        places = np.stack([easting, northing])
        far = ~(np.hypot(*np.diff(places)) <= near_m)
        return largest_tile_step(
            places[:, :-1],
            places[:, 1:],
            np.where(far, -1, tiles[:-1]),
            tiles[1:],
            [bounds for bounds, _ in surfaces],
            lambda number, x, y, _: surfaces[number][1].height(x, y),
        )

    def errors(self, easting: Floats, northing: Floats, numbers: NDArray[np.int8]) -> Floats:
        """Return the estimated errors (m) of the surface at n points on given levels.

        They are those of the cell at each point. NaN off the finished tiles, and where the sources of a tile
        have changed or are gone.
        """
        error = np.full(easting.shape, np.nan)
        for status, selected in self._owners(easting, northing):
            if not status.done:
                continue
            tile = GroundTile.of(FinishedTile.of(self.run, status, self.variant))
            for number in np.unique(numbers[selected]).tolist():
                here = selected[numbers[selected] == number]
                estimates = estimate(tile, number)
                if estimates is not None:
                    error[here] = estimates[0][tile.grid.cells(easting[here], northing[here])]
        return error

    def on_every_level(self, easting: Floats, northing: Floats) -> tuple[NDArray[np.intp], Answer]:
        """Return what `at` returns for all levels of each point, and the number of the point of each row.

        The rows of a point are ordered by level, and its first one is that of the ground.
        """
        ground = self.at(easting, northing, 0)
        answers = [ground, *(self.at(easting, northing, k) for k in ground.numbers if k != 0)]
        kept = [
            np.arange(len(answer.height)) if answer is ground else np.flatnonzero(np.isfinite(answer.height))
            for answer in answers
        ]
        points = np.concatenate(kept)
        columns: dict[str, Any] = {
            name: np.concatenate(
                [getattr(answer, name)[rows] for answer, rows in zip(answers, kept, strict=True)]
            )
            for name in ("height", "normal", "tile", "kind", "flags", "level")
        }
        order = np.lexsort((columns["level"], columns["level"] != 0, points))
        columns = {name: values[order] for name, values in columns.items()}
        return points[order], replace(ground, **columns)

    def _flags(self, status: TileStatus, number: int, easting: Floats, northing: Floats) -> Bits:
        """Return the flags of the cells of a tile at points, on a level."""
        if status.done:
            cells = flagged(GroundTile.of(FinishedTile.of(self.run, status, self.variant)), number)
        else:
            nodes = self.run.folder(status.graph.tile.id).nodes(self.variant)
            last = RunPlace.of(self.run).artefacts.find("assess", nodes.get("assess", ""))
            if last is None:
                return np.full(easting.shape, UNKNOWN)
            cells = last.value.at(number).flagged
        return cells[status.graph.around.grid.cells(easting, northing)]

    def _surfaces(
        self, easting: Floats, northing: Floats
    ) -> Iterator[tuple[TileStatus, Surface, RoadMask, NDArray[np.intp]]]:
        """Yield what `_owners` does, with surface and road of each tile that still has them."""
        for status, selected in self._owners(easting, northing):
            found = self._current(status) if status.done else self._last(status.graph.tile.id)
            if found is not None:
                yield status, *found, selected

    def _owners(self, easting: Floats, northing: Floats) -> Iterator[tuple[TileStatus, NDArray[np.intp]]]:
        """Yield the state of each finished tile that has points, with the indices of the points."""
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
        unassigned = np.ones(easting.shape, dtype=bool)
        statuses = peek_statuses(self.run, [tiles[i] for i in numbers])
        for status, indices in zip(statuses, np.split(point[order], starts[1:]), strict=True):
            indices = indices[unassigned[indices]]
            if indices.size and self._finished(status):
                unassigned[indices] = False
                yield status, indices

    def _finished(self, status: TileStatus) -> bool:
        last = status.last_record
        return status.done or (self.earlier and last is not None and last.state == "done")

    def _last(self, tile_id: str) -> tuple[Surface, RoadMask] | None:
        """Return what a tile had when it was last finished, None if the store no longer has it."""
        nodes = self.run.folder(tile_id).nodes(self.variant)
        return RunPlace.of(self.run).stored(nodes.get("fit", ""), nodes.get("segment", ""))

    def _current(self, status: TileStatus) -> tuple[Surface, RoadMask]:
        tile = FinishedTile.of(self.run, status, self.variant)
        return tile.surface, tile.road


def _inside(
    road: RoadMask, easting: Floats, northing: Floats, selected: NDArray[np.intp]
) -> NDArray[np.intp]:
    """Return those of the selected points that are not beyond the survey."""
    return selected[~road.outside[road.grid.cells(easting[selected], northing[selected])]]


def _by_level(
    surface: Surface, easting: Floats, northing: Floats, selected: NDArray[np.intp], level: int | None
) -> Iterator[tuple[int, NDArray[np.intp], Surface]]:
    """Yield each level with its points among the selected ones, and its surface."""
    if not isinstance(surface, LevelledSurface):
        if level in (None, 0):
            yield 0, selected, surface
        return
    east, north = easting[selected], northing[selected]
    top = surface.top(east, north)
    for number in surface.numbers:
        if level is None:
            here = top == number
        elif level == number:
            here = np.ones(len(selected), np.bool_) if number == 0 else surface.covers(number, east, north)
        else:
            continue
        yield number, selected[here], surface.at(number)


def crs_of(ground: Ground) -> str | None:
    """Return the CRS of a run, None if its tiles have several."""
    systems = {tile.grid.crs for tile in ground.run.catalog.usable}
    return systems.pop() if len(systems) == 1 else None


def required_crs(ground: Ground) -> str:
    """Return the CRS of a run."""
    crs = crs_of(ground)
    if crs is None:
        raise ConfigError(
            f"the tiles of {ground.run.path} have several CRSs; give points in that of the tile, as a CSV "
            "with easting and northing"
        )
    return crs


def to_crs(x: Floats, y: Floats, source: str | None, target: str) -> tuple[Floats, Floats]:
    """Return coordinates in another CRS; NaN where they cannot be transformed.

    - `x`, `y` ``(n,)``: first east, then north, whatever the order of the axes of the CRS.
    - `source`: none if they already are in the CRS ``target``.
    """
    if source is None or same(source, target):
        return x, y
    east, north = transformer(source, target).transform(x, y)
    finite = np.isfinite(east) & np.isfinite(north)
    return np.where(finite, east, math.nan), np.where(finite, north, math.nan)
