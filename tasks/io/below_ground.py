"""A surface model below the terrain model: a sign that the two files were swapped."""

from __future__ import annotations

import numpy as np

from flexroad.tasks.types import Floats

BELOW_M = 1.0
"""Distance from which a surface below the ground counts, or one above it (m)."""
SHARE, TIMES = 0.05, 4.0
"""Share of the cells with a surface below the ground that is noted, if it is so many times that above it."""


def below_ground_note(dsm: Floats, dtm: Floats) -> str | None:
    """Return a note if a DSM is below a DTM (m, same shape) in many cells and above it in few; else None.

    Noise, and ground that was dug off between two surveys, puts some cells below; buildings and trees put
    more of them above, unless the files are swapped.
    """
    above = dsm - dtm
    known = np.count_nonzero(np.isfinite(above))
    below = np.count_nonzero(above < -BELOW_M)
    if not below or below < SHARE * known:
        return None
    low, high = below / known, np.count_nonzero(above > BELOW_M) / known
    if low < TIMES * high:
        return None
    return (
        f"the DSM is more than {BELOW_M:g} m below the DTM in {low:.0%} of the cells and above it in "
        f"{high:.0%}: are their files swapped?"
    )
