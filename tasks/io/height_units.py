"""Units of heights that raster files declare, and values that cannot be heights."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from flexroad.catalog.crs import Unit, height_unit, is_projected, plan_unit
from flexroad.catalog.text import count
from flexroad.catalog.tile import HIGHEST_M, LOWEST_M, Layer
from flexroad.tasks.errors import TaskError, Unusable
from flexroad.tasks.io.raster import RasterWindow
from flexroad.tasks.types import Floats

SMALLER = {"cm": 100, "mm": 1000}
"""Possible units of heights outside the range, with their number in a metre."""

METRE: Unit = ("metre", 1.0)

CONVERTED = ", as the file says, converted to metres"
"""End of notes on heights that were not in metres."""

UNITS = {
    **dict.fromkeys(("m", "metre", "meter", "metres", "meters"), 1.0),
    **dict.fromkeys(("ft", "foot", "feet", "international foot"), 0.3048),
    **dict.fromkeys(("us-ft", "us-foot", "ftus", "foot_us", "us survey foot", "us survey feet"), 1200 / 3937),
    **dict.fromkeys(("cm", "centimetre", "centimeter"), 0.01),
    **dict.fromkeys(("mm", "millimetre", "millimeter"), 0.001),
}
"""Size (m) of the units of height that bands declare; names in lower case."""


def with_unit(patch: RasterWindow, layer: Layer) -> RasterWindow:
    """Return a patch of heights with its unit: if it is not declared, from the catalog or the CRS."""
    if patch.unit or patch.crs is None or height_unit(patch.crs):
        return patch
    unit, metres = plan_unit(patch.crs)
    implied = unit if patch.lattice.crs and is_projected(patch.crs) and metres != 1 else ""
    unit = layer.height_unit or implied
    return replace(patch, unit=unit, unit_assumed=bool(unit))


def in_metres(patch: RasterWindow) -> tuple[RasterWindow, int]:
    """Return the patch with heights in metres, and the number of cells outside the range of heights."""
    values = patch.values * _unit(patch)[1]
    return replace(patch, values=values), remove_absurd(values)


def remove_absurd(heights: Floats) -> int:
    """Set heights (m) outside `LOWEST_M` to `HIGHEST_M` to NaN, in place; return their number."""
    absurd = (heights < LOWEST_M) | (heights > HIGHEST_M)
    heights[absurd] = np.nan
    return int(np.count_nonzero(absurd))


def absurd_note(layer: str, removed: int) -> str:
    """Return the note on heights that `remove_absurd` removed from a layer."""
    return f"{layer}: {count(removed, 'cell')} outside {LOWEST_M:g}..{HIGHEST_M:g} m taken as nodata"


def converted_note(layer: str, patch: RasterWindow) -> str | None:
    """Return a note if a patch of heights was converted from the unit that its file declares, or None."""
    unit, metres = _unit(patch)
    if metres == 1 or patch.unit_assumed:
        return None
    return f"{layer}: heights in {unit}{CONVERTED}"


def is_conversion(note: str) -> bool:
    """Return whether a note of a tile comes from `converted_note`."""
    return note.endswith(CONVERTED)


def smaller_unit_fault(patch: RasterWindow, declare: str) -> str | None:
    """Return the fault of heights outside the range that are in a smaller unit, to follow the file's name.

    None if they vary too little or too much for heights in a unit of `SMALLER`.

    - `declare`: a further remedy besides the division, with a comma before it; or empty.
    """
    heights = patch.values * _unit(patch)[1]
    most = max(SMALLER.values())
    heights = heights[(heights >= LOWEST_M * most) & (heights <= HIGHEST_M * most)]
    heights = heights[(heights < LOWEST_M) | (heights > HIGHEST_M)]
    low, high = (heights.min(), heights.max()) if heights.size else (0.0, 0.0)
    fitting = [
        unit for unit, number in SMALLER.items() if LOWEST_M <= low / number <= high / number <= HIGHEST_M
    ]
    if low == high or not fitting:
        return None
    numbers = " or ".join(str(SMALLER[unit]) for unit in fitting)
    return (
        f": all {heights.size} heights on this tile are outside {LOWEST_M:g} to {HIGHEST_M:g} m "
        f"({low:.0f} to {high:.0f}); if they are in {' or '.join(fitting)}, divide them by {numbers}{declare}"
    )


def _unit(patch: RasterWindow) -> Unit:
    """Return the unit of heights declared by the band, else by the CRS, else metres."""
    if not patch.unit:
        return (height_unit(patch.crs) if patch.crs else None) or METRE
    metres = UNITS.get(patch.unit.lower())
    if metres is None:
        raise Unusable(
            f"{patch.name} has the unit {patch.unit!r}, which is not a supported unit of height; "
            "convert it, or correct the unit with gdal_edit.py -units m",
            patch.file,
        )
    return patch.unit, metres


def check_units(patches: Sequence[RasterWindow]) -> None:
    """Raise an error if layers differ in their unit of height: usually a tag is missing.

    Files in different CRSs may differ if both declare their unit.
    """
    first = patches[0]
    for patch in patches[1:]:
        (a, a_metres), (b, b_metres) = _unit(first), _unit(patch)
        if (first.lattice.crs or patch.lattice.crs) and _declares_unit(first) and _declares_unit(patch):
            continue
        if not math.isclose(a_metres, b_metres, rel_tol=1e-4):
            raise TaskError(
                f"{first.name} has heights in {a}, {patch.name} in {b}; "
                "convert one, or correct its unit with gdal_edit.py -units",
                patch.file,
            )


def _declares_unit(patch: RasterWindow) -> bool:
    declared = patch.unit and not patch.unit_assumed
    return bool(declared or (patch.crs and height_unit(patch.crs)))
