"""Whether DSM and DTM are of one survey, by the dates and vertical CRSs that their files declare."""

from __future__ import annotations

from typing import Any

from flexroad.catalog import Tile
from flexroad.catalog.crs import vertical
from flexroad.catalog.headers.rasters import date_of, quiet
from flexroad.tasks.io.raster import Unreadable, read_raster


def survey_difference(tile: Tile) -> tuple[str, str]:
    """Return how DSM and DTM differ, and what their files do not declare; "" if nothing.

    Only headers are read. Files that cannot be read are left out, as by `load`.

    Parameters
    ----------
    tile : Tile
        With the files to compare (`Tile.within`).
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
                crs, tags = read_raster(path, name, _crs_and_tags, tile.allowed, missing=tile.missing)
            except Unreadable:
                continue
            taken, crs = date_of(tags), crs or (layer.crs if layer else None)
            found.append((f"{taken:%Y-%m-%d}" if taken else "", (vertical(crs) if crs else None) or ""))
    return found


def _crs_and_tags(raster: Any) -> tuple[str | None, dict[str, str]]:
    """Return the CRS of an open raster as WKT, None if it has none, and its tags."""
    tags = {**raster.tags(), **raster.tags(ns="IMAGERY")}
    return raster.crs.to_wkt() if raster.crs else None, tags
