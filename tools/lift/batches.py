"""Heights for the parts of a file, many at a time: a run reads each of its tiles once per batch."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import TypeVar

import numpy as np

from flexroad.pipeline.run.points import Heights
from flexroad.tasks.types import Floats
from flexroad.tools.lift.types import HeightsAt

POINTS = 500_000
"""Number of points of a batch: some 200 MB with their heights and what they belong to."""

T = TypeVar("T")


def with_heights(
    parts: Iterable[T], points: Callable[[T], tuple[Floats, Floats] | None], heights: HeightsAt
) -> Iterator[tuple[T, Heights | None]]:
    """Yield each part, in its order, with the heights of its points.

    - `points`: returns x and y of the points of a part, ``(n,)`` each; None if it needs no heights.
    - `heights`: heights of a run.
    """
    batch, size = list[tuple[T, tuple[Floats, Floats] | None]](), 0
    for part in parts:
        batch.append((part, points(part)))
        own = batch[-1][1]
        size += 1 if own is None else 1 + len(own[0])
        if size >= POINTS:
            yield from _answered(batch, heights)
            batch, size = [], 0
    yield from _answered(batch, heights)


def _answered(
    batch: list[tuple[T, tuple[Floats, Floats] | None]], heights: HeightsAt
) -> Iterator[tuple[T, Heights | None]]:
    asked = [own for _, own in batch if own is not None]
    if not asked:
        yield from ((part, None) for part, _ in batch)
        return
    x, y = (np.concatenate(values) for values in zip(*asked, strict=True))
    found, start = heights(x, y), 0
    for part, own in batch:
        if own is None:
            yield part, None
        else:
            end = start + len(own[0])
            yield part, found[start:end]
            start = end
