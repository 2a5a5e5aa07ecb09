"""Folders of rasters: GeoTIFF, ASCII grid, XYZ or VRT, in any cut, put into tiles; and roads as vectors."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from datetime import datetime
from pathlib import Path

from flexroad.catalog.errors import CatalogError
from flexroad.catalog.headers.rasters import scan
from flexroad.catalog.headers.vectors import find, with_roads
from flexroad.catalog.tile import LAYERS
from flexroad.catalog.tiling import TilingResult, cut


def index(
    root: Path,
    patterns: Mapping[str, str],
    *,
    road_values: tuple[int, ...] = (),
    tile_size_m: float = 250,
    date: datetime | None = None,
    crs: str | None = None,
    min_cover: float = 0.25,
) -> TilingResult:
    """Cut the ground that the DSM files cover into tiles.

    Parameters
    ----------
    root : Path
        The folder.
    patterns : Mapping[str, str]
        Layer name (see `catalog.LAYERS`) to glob pattern relative to ``root``; ``dsm`` must be there.
        Of ``roads``, vector files, the pattern may be a file anywhere.
    road_values : tuple of int
        Cell values that mean road in the masks; empty: every value but 0 and nodata.
    tile_size_m : float
        Edge of a tile (m); tiles lie on multiples of it in the DSM's CRS.
    date : datetime, optional
        When the data was taken; overrules the files' tags.
    crs : str, optional
        CRS of files that carry none.
    min_cover : float
        Tiles of which the DSM's files cover less than this share (0 to 1) are left out.

    Raises
    ------
    CatalogError
        If a pattern finds nothing usable, the CRS is missing or not in metres, no tile is left, or a file
        of roads reaches none.
    """
    root = root.resolve()
    _check(root, patterns)
    scanned = {
        name: scan(root, name, patterns[name], crs) for name in LAYERS if name in patterns and name != "roads"
    }
    notes = [note for _, skipped in scanned.values() for note in skipped]
    indexed = cut(
        root,
        {name: files for name, (files, _) in scanned.items()},
        road_values=road_values,
        tile_size_m=tile_size_m,
        date=date,
        crs=crs,
        min_cover=min_cover,
    )
    roads = find(root, patterns["roads"], crs) if "roads" in patterns else []
    return replace(indexed, tiles=with_roads(indexed.tiles, roads, crs), notes=(*notes, *indexed.notes))


def _check(root: Path, patterns: Mapping[str, str]) -> None:
    unknown = sorted(set(patterns) - set(LAYERS))
    if unknown:
        raise CatalogError(f"no layer is called {unknown[0]!r}; there are {', '.join(LAYERS)}")
    if "dsm" not in patterns:
        raise CatalogError("a catalog needs surface heights; give their files with --dsm")
    if not root.is_dir():
        raise CatalogError(f"folder {root} does not exist")
