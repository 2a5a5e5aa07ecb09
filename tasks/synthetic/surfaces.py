"""The ground: relief, streets graded into it, and streams they cross on bridges."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tasks.synthetic.network import Stream, Street
from tasks.synthetic.noise import Waves, generator, waves
from tasks.types import Bools, Floats

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


@dataclass(frozen=True, eq=False)
class Relief:
    """Terrain before anything was built."""

    large: Waves
    """Hills and valleys; street profiles follow these alone and are smooth therefore."""
    small: Waves
    """Humps and hollows that streets are cut through."""
    datum_m: float
    """Mean height of the world (m)."""


def relief(seed: int, slope: float, roughness_m: float, datum_m: float) -> Relief:
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
    """
    rng = generator(seed, "relief")
    hills, humps = np.geomspace(320, 2400, 9), np.geomspace(25, 140, 10)
    # All hills are equally steep, so the long ones are the high ones.
    heights = slope * hills / (2 * np.pi) * np.sqrt(2 / hills.size)
    long_is_high = humps / np.sqrt(np.mean(humps**2))
    bumps = roughness_m * long_is_high * np.sqrt(2 / humps.size)
    return Relief(waves(rng, hills, heights), waves(rng, humps, bumps), datum_m)


@dataclass(frozen=True, eq=False)
class Ground:
    """The noise-free ground at some points."""

    graded: Floats
    """Height (m) of terrain and streets as if no stream had ever cut into them."""
    trough: Floats
    """How deep a stream has cut into it (m)."""
    edge: Floats
    """Distance (m) to the nearest carriageway's edge, negative on the road, infinite far away."""

    @property
    def bare(self) -> Floats:
        """Height of the ground without bridges (m)."""
        return self.graded - self.trough

    @property
    def deck(self) -> Bools:
        """Where a bridge carries road and shoulder over a stream."""
        return (self.edge < SHOULDER_M / 2) & (self.trough > 0)

    @property
    def height(self) -> Floats:
        """Height of road and terrain with bridges (m): the truth."""
        return np.where(self.deck, self.graded, self.bare)

    @property
    def road(self) -> Bools:
        """The true carriageways."""
        return self.edge <= 0


def ground(
    land: Relief, streets: Sequence[Street], streams: Sequence[Stream], x: Floats, y: Floats
) -> Ground:
    """Return the ground at points given in the plan's frame, in their shape.

    A street lies at the height of the hills under its centre line, with a rounded crossfall. Near
    streets weigh more than terrain, and where streets meet their heights are averaged with weights that
    fade in, so neither kerb nor crossing makes a step.
    """
    hills = land.large(x, y)
    total, total_weight, heaviest = np.zeros_like(hills), np.zeros_like(hills), np.zeros_like(hills)
    edge = np.full_like(hills, np.inf)
    for street in streets:
        near = _near(street, x, y)
        if not near.any():
            continue
        lift, beyond = _levelled(street, land.large, x[near], y[near])
        weight = 1 - _smoothstep((beyond - SHOULDER_M) / SLOPE_M)
        total[near] += weight * (hills[near] + lift)
        total_weight[near] += weight
        heaviest[near] = np.maximum(heaviest[near], weight)
        edge[near] = np.minimum(edge[near], beyond)
    wild = 1 - heaviest
    graded = (total + wild * (hills + land.small(x, y))) / (total_weight + wild)
    return Ground(graded + land.datum_m, _trough(streams, x, y), edge)


def _levelled(street: Street, hills: Waves, x: Floats, y: Floats) -> tuple[Floats, Floats]:
    """Return by how much the street lifts the hills and the distance from its edge (m).

    Beyond the edge the lift stays that of the edge: were it level there too, a street that climbs away
    from a crossing would first be pulled down to it.
    """
    along, distance = street.foot(x, y)
    inside = np.minimum(street.half_width_m / np.maximum(distance, 1e-9), 1)
    middle_x, middle_y = street.point(along, 0.0)
    at_x, at_y = middle_x + (x - middle_x) * inside, middle_y + (y - middle_y) * inside
    rounded = CROSSFALL * street.half_width_m * np.minimum(distance / street.half_width_m, 1) ** 2
    lift = hills(middle_x, middle_y) - hills(at_x, at_y) - rounded
    return lift, distance - street.half_width_m


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
