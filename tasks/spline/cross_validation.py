"""How stiff a plate the data bear: generalised cross-validation, made robust.

The score of a surface is its mean absolute difference to the road's cells over ``(1 - freedom / cells)^2``
(Craven and Wahba 1979, with the absolute in place of the squared difference). It tells how well a cell would
be met that took no part in the fit, if errors of neighbouring cells have nothing to do with each other: where
crowns or cars are left in the mask they have, and the score rewards following them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from flexroad.tasks.spline.irls import Convex, Solution, freedom
from flexroad.tasks.spline.thin_plate import Plate
from flexroad.tasks.types import Bools, Floats

CANDIDATES_M3 = (1000.0, 300.0, 100.0, 30.0, 10.0)
WORSE = 0.03
"""The stiffest plate is taken whose score is at most this part above the best."""


def stiffest(
    flat: Convex, unit: Plate, start: Floats, road: Bools, solved: Callable[[Convex, Floats], Solution]
) -> Solution:
    """Return the solution with the stiffest plate that the road's cells bear, all cells' if there are none.

    Parameters
    ----------
    flat : Convex
        The loss without a plate.
    unit : Plate
        The plate of 1 m3.
    start : ndarray, (m, n)
        Control heights (m).
    road : ndarray of bool, (H, W)
    solved : callable
        Minimises a loss from control heights.
    """
    known = flat.objective.factor > 0
    cells = road & known if (road & known).any() else known
    solutions: list[Solution] = []
    scores: list[float] = []
    for stiffness in CANDIDATES_M3:
        convex = replace(flat, plate=unit.times(stiffness))
        # From the stiffer surface: the next one lies near.
        solutions.append(solved(convex, solutions[-1].z if solutions else start))
        scores.append(_score(convex, solutions[-1], cells))
    best = min(scores)
    return next(s for s, score in zip(solutions, scores, strict=True) if score <= (1 + WORSE) * best)


def _score(convex: Convex, solution: Solution, cells: Bools) -> float:
    left = 1 - freedom(convex, solution, cells) / np.count_nonzero(cells)
    return float(np.abs(solution.off[cells]).mean() / max(left, np.finfo(float).eps) ** 2)
