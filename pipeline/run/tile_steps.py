"""Steps between the surfaces of neighbouring tiles, of methods whose tiles have no common borders."""

from __future__ import annotations

LARGEST_M = 0.05
"""Step up to which tiles carry a road; tiles with common borders meet."""
REMEDY = "use a run of production, whose tiles have common borders"


def length_text(metres: float, digits: int = 0) -> str:
    """Return a length for the user, in millimetres below one metre."""
    return f"{1000 * metres:.{digits}f} mm" if metres < 1 else f"{metres:.2f} m"
