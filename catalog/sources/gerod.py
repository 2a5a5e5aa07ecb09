"""GeRoD, the paper's GeoRoad dataset: 240 tiles of 250 x 250 m of North Rhine-Westphalia.

The file names of the published archive are not fixed here; templates describe them
(`catalog.path_templates`). The templates in ``configs/gerod.yaml`` are a guess, to be adapted to the archive.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Any

from flexroad.catalog.headers.rasters import some
from flexroad.catalog.path_templates import Layout, read
from flexroad.catalog.tile import Tile
from flexroad.catalog.tiling import TilingResult

DATASET = "GeRoD"
TILES = 240
CORNER = re.compile(r"(\d+)_(\d+)")
"""Ids are the south-west corner in whole metres: the paper's ``295500_5629250``."""


def index(root: Path, layout: Mapping[str, Any], *, date: datetime | None = None) -> TilingResult:
    """Return the tiles of the dataset's folder.

    Parameters
    ----------
    root : Path
        The folder.
    layout : Mapping[str, Any]
        ``layers`` (templates), ``road_values`` and ``crs``, as in a configuration's ``dataset``.
    date : datetime, optional
        Date of the survey; overrides the files' dates.

    Raises
    ------
    CatalogError
        If the layout is invalid, or the folder does not match it.
    """
    result = read(root, Layout.of(layout), dataset=DATASET, date=date)
    notes = (*result.notes, *_misplaced(result.tiles))
    if len(result.tiles) != TILES:
        notes += (f"{len(result.tiles)} of the dataset's {TILES} tiles are here",)
    return replace(result, notes=notes)


def _misplaced(tiles: Sequence[Tile]) -> list[str]:
    """Return a note on tiles that are not at the corner in their id: the template or CRS is wrong."""
    off = [tile.id for tile in tiles if not _is_at_id(tile)]
    return [f"not at the corner given by the tile's name: {some(off)}; check layout and CRS"] if off else []


def _is_at_id(tile: Tile) -> bool:
    """Return whether the tile's south-west corner is the one in its id, to within one cell."""
    corner = CORNER.fullmatch(tile.id)
    # Some programs write rasters of points, which begin half a cell before the corner.
    return (
        corner is not None and math.dist(map(float, corner.groups()), tile.grid.bounds[:2]) <= tile.grid.cell
    )
