"""The ground: relief, streets graded into it, and streams that streets cross on bridges."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from types import EllipsisType

import numpy as np

from flexroad.tasks.types import Bools, Floats
from flexroad.tools.synthetic.network import Stream, Street
from flexroad.tools.synthetic.world import Waves, field, generator, waves

CROSSFALL = 0.025
"""Mean cross slope from a street's middle to its edge."""
SHOULDER_M = 2.0
"""Width of the strip beside the carriageway that is graded with it (m)."""
SLOPE_M = 9.0
"""Width over which embankments and cuttings blend into the terrain (m)."""
REACH_M = SHOULDER_M + SLOPE_M
"""Distance from the carriageway over which a street changes the terrain (m)."""
STREAM_DEPTH_M = 5.0
BED_M = 4.0
"""Half width of a stream's flat bed (m)."""
BANK_M = 8.0
"""Width of each bank (m)."""
SUNKEN_M = 3.6
"""Half width of a sunken road (m)."""
CIRCLE_M, ISLAND_M = 15.0, 7.0
"""Radius of a roundabout and of its island (m)."""


@dataclass(frozen=True, eq=False)
class Relief:
    """The terrain without streets."""

    large: Waves
    """Hills and valleys (m). Streets follow only these, so streets are smooth."""
    small: Waves
    """Small humps and hollows (m); streets cut through them."""
    datum_m: float
    """Mean height of the world (m)."""
    grading: Waves
    """Height of streets above or below the hills (m): embankments and cuttings."""


def relief(seed: int, slope: float, roughness_m: float, datum_m: float, embankment_m: float = 0.0) -> Relief:
    """Return the relief of a world.

    - `roughness_m`: root mean square height of the humps (m).
    - `datum_m`: mean height of the world (m).
    - `embankment_m`: root mean square height of streets above or below the hills (m).
    """
    rng = generator(seed, "relief")
    hills, humps = np.geomspace(320, 2400, 9), np.geomspace(25, 140, 10)
    # All waves of the hills are equally steep, so amplitude is proportional to wavelength.
    heights = slope * hills / (2 * np.pi) * np.sqrt(2 / hills.size)
    relative = humps / np.sqrt(np.mean(humps**2))
    bumps = roughness_m * relative * np.sqrt(2 / humps.size)
    grading = field(seed, "grading", (160, 500), 5, embankment_m)
    return Relief(waves(rng, hills, heights), waves(rng, humps, bumps), datum_m, grading)


@dataclass(frozen=True, eq=False)
class Ground:
    """The noise-free ground at some points."""

    graded: Floats
    """Height of terrain and streets without the cuts of streams (m)."""
    trough: Floats
    """Depth of the cut of a stream or sunken road (m)."""
    edge: Floats
    """Distance to the nearest carriageway's edge (m), negative on the road, infinite far away."""
    over: Floats
    """Like ``edge``, without sunken roads (m): only the other carriageways may lie on a bridge."""

    @property
    def bare(self) -> Floats:
        """Height of the ground without bridges (m)."""
        return self.graded - self.trough

    @property
    def deck(self) -> Bools:
        """Cells of bridges, where road and shoulder cross a stream or a sunken road."""
        return (self.over < SHOULDER_M / 2) & (self.trough > 0)

    @property
    def height(self) -> Floats:
        """True height of road and terrain with bridges (m)."""
        return np.where(self.deck, self.graded, self.bare)

    @property
    def road(self) -> Bools:
        """The true carriageways."""
        return self.edge <= 0


def ground(
    land: Relief,
    streets: Sequence[Street],
    streams: Sequence[Stream],
    circles: Sequence[tuple[float, float]],
    curb_m: float,
    x: Floats,
    y: Floats,
) -> Ground:
    """Return the ground at points given in the plan's frame, in their shape.

    A street has the height of the hills under its centre line, with a rounded crossfall. Its weight decreases
    smoothly from its edge into the terrain. Where streets meet, the weighted mean of their heights is used,
    so there is no step at crossings. Kerbs are added.

    - `circles`: centres of roundabouts.
    - `curb_m`: height of the pavement over the carriageway's edge (m).
    """
    hills = land.large(x, y)
    blend = _Blend.of(hills)
    for street in streets:
        near = _near(street, x, y)
        if near.any():
            lift, beyond, edge = _street_lift(street, land, x[near], y[near])
            blend.add(near, hills[near] + lift, beyond, edge)
    for centre in circles:
        away = np.hypot(x - centre[0], y - centre[1])
        blend.add(..., hills + land.grading(x, y), away - CIRCLE_M, away - CIRCLE_M)
        np.maximum(blend.edge, ISLAND_M - away, out=blend.edge)
    over = blend.edge.copy()
    for stream in streams:
        if stream.paved:
            beyond = stream.distance(x, y) - SUNKEN_M
            # Streets cross the sunken road on bridges at their own height.
            blend.add(..., hills, beyond, beyond, 1 - blend.heaviest)
    graded = blend.with_terrain(hills + land.small(x, y)) + land.datum_m
    if curb_m:
        # A step up, a level pavement, then a slope down.
        graded = graded + curb_m * (smoothstep(over / 0.2) - smoothstep((over - 2.2) / 1.5))
    return Ground(graded, _trough(streams, x, y), blend.edge, over)


@dataclass(frozen=True, eq=False)
class _Blend:
    """Sums of street heights weighted by proximity; updated in place."""

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
        weight = share * (1 - smoothstep((beyond - SHOULDER_M) / SLOPE_M))
        self.total[where] += weight * height
        self.weights[where] += weight
        self.heaviest[where] = np.maximum(self.heaviest[where], weight)
        self.edge[where] = np.minimum(self.edge[where], edge)

    def with_terrain(self, terrain: Floats) -> Floats:
        rest = 1 - self.heaviest
        blended: Floats = (self.total + rest * terrain) / (self.weights + rest)
        return blended


def _street_lift(street: Street, land: Relief, x: Floats, y: Floats) -> tuple[Floats, Floats, Floats]:
    """Return the height of a street above the hills, and the distances to its outer and nearest edge (m).

    Beyond the edge the height difference of the edge is kept. With a level continuation, a street that climbs
    away from a crossing would be lowered to the crossing's height.
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


def _near(street: Street, x: Floats, y: Floats) -> Bools:
    west, south, east, north = street.box
    reach = street.half_width_m + REACH_M
    return (x > west - reach) & (x < east + reach) & (y > south - reach) & (y < north + reach)


def _trough(streams: Sequence[Stream], x: Floats, y: Floats) -> Floats:
    depth = np.zeros_like(x)
    for stream in streams:
        cut = STREAM_DEPTH_M * (1 - smoothstep((stream.distance(x, y) - BED_M) / BANK_M))
        depth = np.maximum(depth, cut)
    return depth


def smoothstep(t: Floats) -> Floats:
    """Return a smooth rise from 0 (at 0 and below) to 1 (at 1 and above)."""
    t = np.clip(t, 0, 1)
    return t * t * (3 - 2 * t)
