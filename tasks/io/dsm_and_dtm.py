"""Checks of a DSM against a DTM: whether they are swapped, and whether they are of one survey."""

from __future__ import annotations

from typing import Any

import numpy as np

from flexroad.catalog import Tile
from flexroad.catalog.crs import vertical
from flexroad.catalog.scan.rasters import date_of, quiet
from flexroad.tasks.io.raster import Unreadable, read_raster
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


def survey_difference(tile: Tile) -> tuple[str, str]:
    """Return how DSM and DTM differ, and what their files do not declare; "" if nothing.

    Only headers are read. Files that cannot be read are left out, as by `load`.

    - `tile`: with the files to compare (`Tile.within`).
    """
    declared = {name: _declared(tile, name) for name in ("dsm", "dtm")}
    differs, missing = [], []
    for number, what in enumerate(("date", "vertical CRS")):
        dsm, dtm = ({file[number] for file in declared[name]} for name in ("dsm", "dtm"))
        if dsm - {""} and dtm - {""} and dsm - {""} != dtm - {""}:
            differs.append(f"{what}: dsm {', '.join(sorted(dsm))}, dtm {', '.join(sorted(dtm))}")
        elif dsm | dtm != (dsm & dtm) - {""}:
            missing.append(what)
    return "; ".join(differs), " and ".join(missing)


def _declared(tile: Tile, name: str) -> list[tuple[str, str]]:
    """Return date and vertical CRS of each file of a layer, "" where it declares none."""
    layer = tile.layer(name)
    found: list[tuple[str, str]] = []
    with quiet():
        for path in tile.paths(layer) if layer else ():
            try:
                crs, tags = read_raster(path, name, _crs_and_tags, missing=tile.missing)
            except Unreadable:
                continue
            taken, crs = date_of(tags), crs or (layer.crs if layer else None)
            found.append((f"{taken:%Y-%m-%d}" if taken else "", (vertical(crs) if crs else None) or ""))
    return found


def _crs_and_tags(raster: Any) -> tuple[str | None, dict[str, str]]:
    """Return the CRS of an open raster as WKT, None if it has none, and its tags."""
    tags = {**raster.tags(), **raster.tags(ns="IMAGERY")}
    return raster.crs.to_wkt() if raster.crs else None, tags
