"""The level of each point of a road or line: by its attributes, or as its heights go on without a step."""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from itertools import pairwise

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from flexroad.pipeline.run.points import Heights
from flexroad.tasks.roads.level_numbers import OSM_TAGS, level_numbers
from flexroad.tasks.types import Bools, Floats

ANY = np.int8(-128)
"""A wanted level that is not known."""

Numbers = NDArray[np.int8]


def along(heights: Heights, wanted: Numbers) -> tuple[Floats, Numbers]:
    """Return the heights of points along a line, and the numbers of their levels.

    Where a wanted level is known, it is taken; if the point does not have it, level 0. Where it is not, and
    a stretch has several levels, that one is taken with which the grade changes least, from before the
    stretch to behind it. A line that has several levels from end to end is on the highest.

    - `heights`: of n points in their order along a line.
    - `wanted` ``(n,)``: numbers of levels, or `ANY`.
    """
    z, numbers = heights.ground.copy(), np.zeros(len(wanted), np.int8)
    others = [(number, row) for number, row in zip(heights.numbers, heights.z, strict=True) if number != 0]
    for number, row in others:
        chosen = np.isfinite(row) & (wanted == number)
        z[chosen], numbers[chosen] = row[chosen], number
    for start, end in stretches(heights.several & (wanted == ANY)):
        candidates = [(0, z[start:end].copy())]
        candidates += [
            (number, row[start:end]) for number, row in others if np.isfinite(row[start:end]).all()
        ]
        # The highest first: it is taken where levels are equally smooth.
        candidates.sort(key=lambda candidate: -candidate[0])
        around = slice(max(start - 2, 0), end + 2)
        bends = [_bend(z, around, start, end, values) for _, values in candidates]
        alone = start == 0 and end == len(z)
        number, values = candidates[0 if alone else int(np.argmin(bends))]
        z[start:end], numbers[start:end] = values, number
    return z, numbers


def level_of(heights: Heights, number: int) -> int | None:
    """Return the level of a bridge or tunnel at n points; None if none of them has one of its kind.

    Sources may number the decks of one place differently, so the nearest number of the same sign counts.
    """
    own = [
        each
        for each, row in zip(heights.numbers, heights.z, strict=True)
        if each * number > 0 and np.isfinite(row).any()
    ]
    return min(own, key=lambda each: (abs(each - number), abs(each))) if own else None


def tagged_level(tags: Mapping[str, str]) -> int:
    """Return the level that tags of OpenStreetMap name: above 0 on a bridge, below 0 in a tunnel."""
    return _tagged_level(tuple((tag, tags[tag]) for tag in OSM_TAGS if tag in tags))


@lru_cache(1000)
def _tagged_level(tags: tuple[tuple[str, str], ...]) -> int:
    return int(level_numbers(pd.DataFrame([dict(tags)]))[0][0]) if tags else 0


def stretches(places: Bools) -> list[tuple[int, int]]:
    """Return start and end of each run of true values."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], places, [False]]).astype(np.int8)))
    return [(int(a), int(b)) for a, b in pairwise(edges)][::2]


def _bend(z: Floats, around: slice, start: int, end: int, values: Floats) -> float:
    """Return the sum of the changes of grade with some heights in a stretch, for points at equal steps."""
    tried = z.copy()
    tried[start:end] = values
    part = tried[around]
    return float(np.nansum(np.abs(np.diff(part[np.isfinite(part)], 2))))
