"""The ground: relief, streets graded into it, and streams they cross on bridges."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from types import EllipsisType

import numpy as np

from flexroad.tasks.synthetic.network import Stream, Street
from flexroad.tasks.synthetic.noise import Waves, generator, waves
from flexroad.tasks.types import Bools, Floats

CROSSFALL = 0.025
"""Mean fall from a street's middle to its edge."""
SHOULDER_M = 2.0
"""Strip beside the carriageway that is graded with it."""
SLOPE_M = 9.0
"""Over which embankments and cuttings run out into the terrain."""
REACH_M = SHOULDER_M + SLOPE_M
STREAM_DEPTH_M = 5.0
BED_M = 4.0
"""Half width of a stream's flat bed."""
BANK_M = 8.0
"""Width of each bank."""
SUNKEN_M = 3.6
"""Half width of a sunken road."""
CIRCLE_M, ISLAND_M = 15.0, 7.0
"""Radius of a roundabout and of its island."""


@dataclass(frozen=True, eq=False)
class Relief:
    """Terrain before anything was built."""

    large: Waves
    """Hills and valleys; street profiles follow these alone and are smooth therefore."""
    small: Waves
    """Humps and hollows that streets are cut through."""
    datum_m: float
    """Mean height of the world (m)."""
    grading: Waves
    """By how much streets lie above or below the hills (m): embankments and cuttings."""


def relief(seed: int, slope: float, roughness_m: float, datum_m: float, embankment_m: float = 0.0) -> Relief:
    """Return the relief of a world.

    Parameters
    ----------
    seed : int
        The world.
    slope : float
        Root mean square slope of the hills.
    roughness_m : float
        Root mean square height of the humps (m).
    datum_m : float
        Mean height of the world (m).
    embankment_m : float
        Root mean square height of streets over or under the hills (m).
    """
    rng = generator(seed, "relief")
    hills, humps = np.geomspace(320, 2400, 9), np.geomspace(25, 140, 10)
    # All hills are equally steep, so the long ones are the high ones.
    heights = slope * hills / (2 * np.pi) * np.sqrt(2 / hills.size)
    long_is_high = humps / np.sqrt(np.mean(humps**2))
    bumps = roughness_m * long_is_high * np.sqrt(2 / humps.size)
    shifts = np.geomspace(160, 500, 5)
    grading = waves(generator(seed, "grading"), shifts, embankment_m * np.sqrt(2 / shifts.size))
    return Relief(waves(rng, hills, heights), waves(rng, humps, bumps), datum_m, grading)


@dataclass(frozen=True, eq=False)
class Ground:
    """The noise-free ground at some points."""

    graded: Floats
    """Height (m) of terrain and streets as if no stream had ever cut into them."""
    trough: Floats
    """How deep a stream has cut into it (m)."""
    edge: Floats
    """Distance (m) to the nearest carriageway's edge, negative on the road, infinite far away."""
    over: Floats
    """The same without the sunken roads: what may lie on a bridge (m)."""

    @property
    def bare(self) -> Floats:
        """Height of the ground without bridges (m)."""
        return self.graded - self.trough

    @property
    def deck(self) -> Bools:
        """Where a bridge carries road and shoulder over a stream or a sunken road."""
        return (self.over < SHOULDER_M / 2) & (self.trough > 0)

    @property
    def height(self) -> Floats:
        """Height of road and terrain with bridges (m): the truth."""
        return np.where(self.deck, self.graded, self.bare)

    @property
    def road(self) -> Bools:
        """The true carriageways."""
        return self.edge <= 0


@dataclass(frozen=True, eq=False)
class Ways:
    """What is cut into the terrain near some points."""

    streets: Sequence[Street]
    streams: Sequence[Stream]
    circles: Sequence[tuple[float, float]] = ()
    """Centres of roundabouts."""
    curb_m: float = 0.0
    """Height of the pavement over the carriageway's edge."""


def ground(land: Relief, ways: Ways, x: Floats, y: Floats) -> Ground:
    """Return the ground at points given in the plan's frame, in their shape.

    A street lies at the height of the hills under its centre line, with a rounded crossfall. Near
    streets weigh more than terrain, and where streets meet their heights are averaged with weights that
    fade in, so neither kerb nor crossing makes a step.
    """
    hills = land.large(x, y)
    blend = _Blend.of(hills)
    for street in ways.streets:
        near = _near(street, x, y)
        if near.any():
            lift, beyond, edge = _levelled(street, land, x[near], y[near])
            blend.add(near, hills[near] + lift, beyond, edge)
    for centre in ways.circles:
        away = np.hypot(x - centre[0], y - centre[1])
        blend.add(..., hills + land.grading(x, y), away - CIRCLE_M, away - CIRCLE_M)
        np.maximum(blend.edge, ISLAND_M - away, out=blend.edge)
    over = blend.edge.copy()
    for stream in ways.streams:
        if stream.paved:
            beyond = stream.distance(x, y) - SUNKEN_M
            # Streets pass over it on their own level.
            blend.add(..., hills, beyond, beyond, 1 - blend.heaviest)
    graded = blend.with_terrain(hills + land.small(x, y)) + land.datum_m
    if ways.curb_m:
        graded = graded + ways.curb_m * _pavement(over)
    return Ground(graded, _trough(ways.streams, x, y), blend.edge, over)


@dataclass(frozen=True, eq=False)
class _Blend:
    """Heights of streets, weighted by how near they are; filled in place."""

    total: Floats
    weights: Floats
    heaviest: Floats
    edge: Floats

    @classmethod
    def of(cls, like: Floats) -> _Blend:
        return cls(np.zeros_like(like), np.zeros_like(like), np.zeros_like(like), np.full_like(like, np.inf))

    def add(
        self,
        where: Bools | EllipsisType,
        height: Floats,
        beyond: Floats,
        edge: Floats,
        share: Floats | float = 1.0,
    ) -> None:
        weight = share * (1 - _smoothstep((beyond - SHOULDER_M) / SLOPE_M))
        self.total[where] += weight * height
        self.weights[where] += weight
        self.heaviest[where] = np.maximum(self.heaviest[where], weight)
        self.edge[where] = np.minimum(self.edge[where], edge)

    def with_terrain(self, terrain: Floats) -> Floats:
        wild = 1 - self.heaviest
        blended: Floats = (self.total + wild * terrain) / (self.weights + wild)
        return blended


def _levelled(street: Street, land: Relief, x: Floats, y: Floats) -> tuple[Floats, Floats, Floats]:
    """Return by how much the street lifts the hills and the distances from its outer and any edge (m).

    Beyond the edge the lift stays that of the edge: were it level there too, a street that climbs away
    from a crossing would first be pulled down to it.
    """
    along, distance = street.foot(x, y)
    beyond = distance - street.half_width_m
    inside = np.minimum(street.half_width_m / np.maximum(distance, 1e-9), 1)
    middle_x, middle_y = street.point(along, 0.0)
    at_x, at_y = middle_x + (x - middle_x) * inside, middle_y + (y - middle_y) * inside
    rounded = CROSSFALL * street.half_width_m * np.minimum(distance / street.half_width_m, 1) ** 2
    lift = land.large(middle_x, middle_y) - land.large(at_x, at_y) - rounded
    lift = lift + land.grading(middle_x, middle_y)
    if street.cross_slope:
        offset = np.clip(street.lateral(x, y, along), -street.half_width_m, street.half_width_m)
        lift = lift + street.cross_slope * offset
    strip = street.strip(along)
    return lift, beyond, np.where(strip > 0, np.maximum(beyond, strip - distance), beyond)


def _pavement(edge: Floats) -> Floats:
    """Return the curb's profile beside an edge: up at once, level, and out into the terrain."""
    up, down = (_smoothstep((edge - start) / width) for start, width in ((0.0, 0.2), (2.2, 1.5)))
    return up - down


def _near(street: Street, x: Floats, y: Floats) -> Bools:
    west, south, east, north = street.box
    reach = street.half_width_m + REACH_M
    return (x > west - reach) & (x < east + reach) & (y > south - reach) & (y < north + reach)


def _trough(streams: Sequence[Stream], x: Floats, y: Floats) -> Floats:
    depth = np.zeros_like(x)
    for stream in streams:
        cut = STREAM_DEPTH_M * (1 - _smoothstep((stream.distance(x, y) - BED_M) / BANK_M))
        depth = np.maximum(depth, cut)
    return depth


def _smoothstep(t: Floats) -> Floats:
    t = np.clip(t, 0, 1)
    return t * t * (3 - 2 * t)
