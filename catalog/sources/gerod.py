"""GeRoD, the paper's GeoRoad dataset: 240 tiles of 250 x 250 m of North Rhine-Westphalia.

How the published archive names its files is not known here, so templates tell (`catalog.layout`); those
of ``configs/gerod.yaml`` are a guess until one has seen the archive.
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
        ``layers`` (templates), ``road_values`` and ``crs``, as a configuration's ``dataset`` holds them.
    date : datetime, optional
        When the data was taken; overrules the files.

    Raises
    ------
    CatalogError
        If the layout is none, or the folder does not hold what it says.
    """
    found = read(root, Layout.of(layout), dataset=DATASET, date=date)
    notes = (*found.notes, *_elsewhere(found.tiles))
    if len(found.tiles) != TILES:
        notes += (f"{len(found.tiles)} of the dataset's {TILES} tiles are here",)
    return replace(found, notes=notes)


def _elsewhere(tiles: Sequence[Tile]) -> list[str]:
    """Return a note on tiles that do not lie at their ids: a wrong template or CRS shows there."""
    off = [tile.id for tile in tiles if not _at_its_id(tile)]
    return [f"not at the corner that its name tells: {some(off)}; are layout and CRS right?"] if off else []


def _at_its_id(tile: Tile) -> bool:
    corner = CORNER.fullmatch(tile.id)
    # Rasters of points, as some programs write them, begin half a cell before the corner.
    return (
        corner is not None and math.dist(map(float, corner.groups()), tile.grid.bounds[:2]) <= tile.grid.cell
    )
