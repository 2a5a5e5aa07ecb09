"""Folders of rasters (GeoTIFF, ASCII grid or XYZ, of any extent), cut into tiles; roads as vectors."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from datetime import datetime
from pathlib import Path

from flexroad.catalog.errors import CatalogError
from flexroad.catalog.scan.cell_values import mask_notes, plateau_notes
from flexroad.catalog.scan.editions import newest_first
from flexroad.catalog.scan.rasters import RasterFile, scan
from flexroad.catalog.scan.vectors import find, with_roads
from flexroad.catalog.tile import HEIGHTS, LAYERS, MIN_COVER
from flexroad.catalog.tiling import MASKS, NO_CONVERSION, Conversion, TilingResult, cut


def index(
    root: Path,
    patterns: Mapping[str, str],
    *,
    road_values: tuple[int, ...] = (),
    tile_size_m: float = 250,
    date: datetime | None = None,
    crs: str | None = None,
    min_cover: float = MIN_COVER,
    conversion: Conversion = NO_CONVERSION,
) -> TilingResult:
    """Cut the area that the DSM files cover into tiles.

    Parameters
    ----------
    root : Path
        The folder.
    patterns : Mapping[str, str]
        Layer name (see `catalog.LAYERS`) to glob pattern; ``dsm`` is required. A pattern is relative to
        ``root``; absolute, or with ``..``, it names files outside. ``roads`` (vector files) may also be the
        path of a file, and end with ``|layername=NAME`` if the files have several layers.
    road_values : tuple of int
        Cell values that mean road in the masks; empty: every value but 0 and nodata.
    tile_size_m : float
        Edge of a tile (m); tiles lie on multiples of it in the DSM's CRS.
    date : datetime, optional
        Date of the survey; overrides the files' tags.
    crs : str, optional
        CRS of files without one.
    min_cover : float
        Tiles with a DSM height in less than this share (0 to 1) of their cells are left out.
    conversion : Conversion
        Whether and where to files in other CRSs are reprojected.

    Raises
    ------
    CatalogError
        If no usable file matches a pattern, the CRS is not in metres, no tile is left, or no file of roads
        reaches a tile.
    """
    root = root.resolve()
    if unknown := sorted(set(patterns) - set(LAYERS)):
        raise CatalogError(f"unknown layer {unknown[0]!r}; layers are {', '.join(LAYERS)}")
    if "dsm" not in patterns:
        raise CatalogError("a catalog needs surface heights; give their files with --dsm")
    if not root.is_dir():
        raise CatalogError(f"folder {root} does not exist")
    scanned = {
        name: scan(root, name, patterns[name], crs) for name in LAYERS if name in patterns and name != "roads"
    }
    skipped = [file for _, files in scanned.values() for file in files]
    notes, files = list[str](), dict[str, list[RasterFile]]()
    for name, (found, _) in scanned.items():
        files[name], lines = newest_first(root, name, found)
        notes += lines
    for name in (mask for mask in MASKS if mask in scanned):
        notes += mask_notes(root, name, [file.name for file in files[name]], road_values)
    for name in (heights for heights in HEIGHTS if heights in scanned):
        notes += plateau_notes(name, {file.name: root / file.name for file in files[name]})
    indexed = cut(
        root,
        files,
        road_values=road_values,
        tile_size_m=tile_size_m,
        date=date,
        crs=crs,
        min_cover=min_cover,
        conversion=conversion,
    )
    indexed = indexed.after(notes, skipped)
    if "roads" not in patterns:
        return indexed
    roads, unusable = find(root, patterns["roads"], crs)
    tiles, far = with_roads(indexed.tiles, roads, crs)
    return replace(indexed, tiles=tiles, skipped=(*indexed.skipped, *unusable, *far))
