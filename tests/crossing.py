"""A street on a deck over another one, in two by two tiles: surfaces, road masks and frames."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import shapely
from shapely.affinity import rotate

from flexroad.catalog.borders import border_of
from flexroad.catalog.grid import Grid
from flexroad.tasks.meshing.road_outline import crossings, encoded
from flexroad.tasks.roads.rasterise import cells
from flexroad.tasks.sample import Options, sample
from flexroad.tasks.spline.frame import Corner, Edge, Frame
from flexroad.tasks.spline.levelled import LevelledSurface
from flexroad.tasks.spline.space import Lattice, surface_on
from flexroad.tasks.types import Level, LevelSpline, Mesh, RoadClusters, RoadMask

WEST, SOUTH = 500000.0, 5600000.0
GROUND_M, DECK_M, RISE = 100.0, 107.0, 0.03


def border_part(border, areas) -> Corner | Edge:
    """Return a corner or an edge without control points, with roads on these areas."""
    if border.kind == "corner":
        return Corner(np.zeros((3, 3)), np.zeros((2, 2), np.bool_))
    road = border.along(cells(areas, border.grid))
    places = crossings(encoded(areas, border.grid), border)
    return Edge(np.zeros((3, 0)), road[1], road[1], np.zeros_like(road), places)


class Tile(NamedTuple):
    """What a tile is sampled from."""

    surface: LevelledSurface
    road: RoadMask
    clusters: RoadClusters
    frame: Frame


@dataclass(frozen=True)
class Crossing:
    """A street that rises to the east and crosses another one on a deck (number below 0: a tunnel)."""

    middle: tuple[float, float] = (40.0, 35.0)
    """Middle of the deck, from the south-western corner of the tiles (m)."""
    angle: float = 0.0
    """Direction of the street, from east to north (degrees)."""
    length: float = 20.0
    width: float = 8.0
    number: int = 1
    size: int = 60
    """Side of a tile (m)."""

    def _placed(self, *areas: shapely.Geometry) -> list[shapely.Geometry]:
        place = np.array([WEST, SOUTH]) + self.middle
        turned = [rotate(area, self.angle, origin=(0, 0)) for area in areas]
        return [shapely.transform(area, lambda points: points + place) for area in turned]

    @property
    def level(self) -> Level:
        """The deck with its two abutments and approaches."""
        half, side = self.length / 2, self.width / 2
        deck = shapely.box(-half, -side, half, side)
        abutments = [shapely.LineString([(x, -side), (x, side)]) for x in (-half, half)]
        approaches = [shapely.box(-half - 16, -side, -half, side), shapely.box(half, -side, half + 16, side)]
        deck, *parts = self._placed(deck, *abutments, *approaches)
        return Level(
            self.number,
            shapely.MultiPolygon([deck]),
            shapely.MultiLineString(parts[:2]),
            shapely.MultiPolygon(parts[2:]),
        )

    @property
    def streets(self) -> np.ndarray:
        """The streets of level 0: before and behind the deck, with a path beside, and below it."""
        half, side = self.length / 2, self.width / 2
        return np.array(
            self._placed(
                shapely.box(-200, -side, -half, side),
                shapely.box(half, -side, 200, side + 2.5),
                shapely.box(-4, -200, 4, 200),
            )
        )

    def tiles(self) -> Iterator[Tile]:
        """Yield the four tiles, from west to east, from south to north."""
        for row in range(2):
            for col in range(2):
                west, north = WEST + col * self.size, SOUTH + (row + 1) * self.size
                yield self.tile(Grid("EPSG:25832", west, north, 1.0, self.size, self.size))

    def mesh(self) -> tuple[Mesh, LevelledSurface]:
        """Return the mesh and the surface of the first tile."""
        tile = next(self.tiles())
        return sample(*tile[:3], Options(), tile.frame), tile.surface

    def tile(self, grid: Grid) -> Tile:
        """Return one tile."""
        nowhere = np.zeros(grid.shape, np.bool_)
        mask = cells(self.streets, grid)
        road = RoadMask(grid, grid, mask, nowhere, areas=encoded(self.streets, grid), levels=(self.level,))
        parts = [self._part(border) for border in border_of(grid, 20.0)]
        return Tile(self.surface(grid), road, RoadClusters(grid, mask.astype(np.int32)), Frame(*parts))

    def surface(self, grid: Grid) -> LevelledSurface:
        """Return the planes of the ground and of the deck."""
        lattice = Lattice.of((grid.width, grid.height), 1.0, 3, 3.6)
        n, m = lattice.intervals
        space, _ = lattice.part(grid.shape, (grid.height, 0), (0, n), (0, m))
        n, m = space.points
        ground = np.full((m, n), GROUND_M)
        spline = surface_on(space, grid, grid.exact_bounds, ground, np.ones_like(ground), 0.0)
        above = np.sign(self.number) * (DECK_M - GROUND_M)
        east = grid.west - WEST + (np.arange(n) - 1.0) * lattice.unit_m[0]
        deck = GROUND_M + above + RISE * east + np.zeros((m, 1))
        return LevelledSurface.of(spline, (LevelSpline(self.level, deck),), grid)

    def _part(self, border) -> Corner | Edge:
        own, level = border_part(border, self.streets), self.level
        if isinstance(own, Corner):
            return own
        deck = border_part(border, shapely.get_parts(level.areas))
        (east, north), along = border.start, deck.crossings
        places = (
            (east + along, north + 0 * along) if border.kind == "east" else (east + 0 * along, north + along)
        )
        on_abutment = shapely.dwithin(level.abutments, shapely.points(*places), 0.05)
        every = np.union1d(own.crossings, deck.crossings[on_abutment])
        return replace(own, crossings=every, levels=((self.number, deck),))
