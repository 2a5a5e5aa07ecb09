"""Downloads of Geobasis NRW (North Rhine-Westphalia), recognised by their names and cut into tiles.

The state delivers squares of a kilometre, as in ``dom1_32_356_5699_1_nw_2020.tif``: product, UTM zone,
kilometres of the south-west corner, length of the side (km), state, year of the survey (in newer names).
``dom1`` is the surface model, ``dgm1`` the terrain model, ``dop10rgbi`` the orthophoto, ``3dm`` the
classified point cloud. Product and year are taken from the name, the position from the file.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from affine import Affine

from flexroad.catalog.crs import short
from flexroad.catalog.derived import is_current, write_heights
from flexroad.catalog.errors import CatalogError
from flexroad.catalog.grid import Bounds
from flexroad.catalog.guard.open_raster import open_raster
from flexroad.catalog.scan.cell_values import mask_notes, plateau_notes
from flexroad.catalog.scan.editions import newest_first
from flexroad.catalog.scan.point_clouds import chunks
from flexroad.catalog.scan.rasters import RasterFile, glob, opened, scan, there, unlisted_folders
from flexroad.catalog.scan.vectors import find, with_roads
from flexroad.catalog.skipped import Skipped, lines
from flexroad.catalog.text import some
from flexroad.catalog.tile import HEIGHTS, MIN_COVER
from flexroad.catalog.tiling import Conversion, TilingResult, cut

CRS = "EPSG:25832"
"""CRS of all downloads; XYZ files do not declare it."""
DATASET = "Geobasis NRW"

NAME = re.compile(
    r"(?P<product>dom1|dgm1|dop\d+[a-z]*|3dm)_32_(?P<east>\d{3})_(?P<north>\d{4})_(?P<side>\d{1,2})_nw"
    r"(?:_(?P<year>\d{4}))?\.(?P<form>tif|xyz|xyz\.gz|jp2|laz)",
    re.IGNORECASE,
)
LAYER_OF = {"dom": "dsm", "dgm": "dtm", "dop": "dop"}
"""Layer by the first letters of the product; point clouds are not a layer."""
DECK = 17
"""Class of bridge decks (ASPRS LAS 1.4); terrain models do not contain bridges."""
DECK_CELL_M = 1.0


@dataclass(frozen=True)
class Download:
    """A downloaded file and the properties in its name."""

    path: Path
    layer: str | None
    """Layer of the catalog, or None for a point cloud."""
    square: Bounds
    """Bounds according to the name (m, EPSG:25832)."""
    year: int
    """Year of the survey; 0 if the name has none."""


def parse(path: Path) -> Download | None:
    """Return the properties in a file's name, or None if it is not a download of Geobasis NRW."""
    name = NAME.fullmatch(path.name)
    if name is None:
        return None
    west, south, side = (1000.0 * int(name[part]) for part in ("east", "north", "side"))
    square = (west, south, west + side, south + side)
    return Download(path, LAYER_OF.get(name["product"][:3].lower()), square, int(name["year"] or 0))


def index(
    root: Path,
    *,
    road_mask: str | None = None,
    road_values: tuple[int, ...] = (),
    tile_size_m: float = 250,
    date: datetime | None = None,
    min_cover: float = MIN_COVER,
    derived: Path | None = None,
    roads: str | None = None,
    reproject: bool = False,
) -> TilingResult:
    """Cut the downloads below a folder into tiles; where files overlap, the newest is used first.

    Parameters
    ----------
    root : Path
        The folder; subfolders are searched as well.
    road_mask : str, optional
        Glob pattern, relative to ``root``, of rasters with road cells; the state does not provide any.
    road_values : tuple of int
        Cell values that mean road in them; empty: every value but 0 and nodata.
    tile_size_m : float
        Edge of a tile (m).
    date : datetime, optional
        Date of the survey; overrides the dates in names and tags.
    min_cover : float
        Tiles with a DSM height in less than this share (0 to 1) of their cells are left out.
    derived : Path, optional
        Folder for rasters of the bridge points (class 17) of the point clouds; together with the terrain
        model they are the paper's extended DTM. If None, the clouds are not read, and a note is added.
    roads : str, optional
        Vector files of roads: a file, or a glob pattern relative to ``root``; and ``|layername=NAME`` if they
        have several layers.
    reproject : bool
        Warp a mask in another CRS when it is read.

    Raises
    ------
    CatalogError
        If there is no usable surface model, no usable file matches the pattern of the mask or the roads, or
        no tile is left; also the errors of `newest_first`.
    """
    root = root.resolve()
    downloads, skipped = _downloads(root)
    layer_files: dict[str, list[RasterFile]] = {}
    bridges, notes, unusable = _bridges(root, downloads, derived)
    skipped += unusable
    if bridges:
        layer_files["bridges"] = bridges
    for layer in LAYER_OF.values():
        named = [download for download in downloads if download.layer == layer]
        files, unusable = opened(root, layer, [download.path for download in named], CRS)
        files, misplaced = _placed(root, files, named)
        skipped += [*unusable, *misplaced]
        if files:
            layer_files[layer], dated = newest_first(root, layer, files)
            notes += dated
    if "dsm" not in layer_files:
        why = lines(skipped)[0] if skipped else there(root)
        raise CatalogError(f"no usable dom1_32_E_N_1_nw*.tif, .xyz or .xyz.gz below {root}; {why}")
    if road_mask is not None:
        masks, unusable = scan(root, "road_mask", road_mask, CRS)
        layer_files["road_mask"], dated = newest_first(root, "road_mask", masks)
        notes += dated
        skipped += unusable
        notes += mask_notes(root, "road_mask", [file.name for file in layer_files["road_mask"]], road_values)
    for layer in (heights for heights in HEIGHTS if heights in layer_files):
        notes += plateau_notes(layer, {file.name: root / file.name for file in layer_files[layer]})
    indexed = cut(
        root,
        layer_files,
        road_values=road_values,
        tile_size_m=tile_size_m,
        date=date,
        crs=CRS,
        min_cover=min_cover,
        dataset=DATASET,
        conversion=Conversion(reproject),
    )
    indexed = indexed.after(notes, skipped)
    if roads is not None:
        vectors, unusable = find(root, roads, CRS)
        tiles, far = with_roads(indexed.tiles, vectors, CRS)
        indexed = replace(indexed, tiles=tiles, skipped=(*indexed.skipped, *unusable, *far))
    if lacking := [tile.id for tile in indexed.tiles if tile.layer("dtm") is None]:
        fault = f"no dgm1 file under {some(lacking)}: these tiles will fail"
        indexed = replace(indexed, notes=(*indexed.notes, f"{fault}; download the terrain model as well"))
    return indexed


def _downloads(root: Path) -> tuple[list[Download], list[Skipped]]:
    """Return the downloads below a folder, newest first, and the folders that cannot be listed."""
    if not root.is_dir():
        raise CatalogError(f"folder {root} does not exist")
    found, unlisted = glob(root, "**/*")
    downloads = [download for download in map(parse, found) if download]
    # The first file with a value is used.
    newest = sorted(downloads, key=lambda download: -download.year)
    return newest, unlisted_folders(root, "downloads", unlisted)


def _placed(
    root: Path, files: Sequence[RasterFile], named: Sequence[Download]
) -> tuple[list[RasterFile], list[Skipped]]:
    """Return the files whose position matches their name, dated by it, and the others."""
    by_name = {download.path.relative_to(root).as_posix(): download for download in named}
    kept, misplaced = list[RasterFile](), list[Skipped]()
    for file in files:
        download = by_name[file.name]
        west, south, east, north = download.square
        x, y = (file.bounds[0] + file.bounds[2]) / 2, (file.bounds[1] + file.bounds[3]) / 2
        if file.crs == CRS and west < x < east and south < y < north:
            # The date is the year in its name, unless its tags give a date in that year.
            year = 0 if file.taken and file.taken.year == download.year else download.year
            kept.append(replace(file, taken=datetime(year, 1, 1, tzinfo=UTC)) if year else file)
        else:
            reason = f"its centre {x:.0f} {y:.0f} in {short(file.crs)} does not match its name"
            reason = f"{reason}; download it again"
            misplaced.append(Skipped(file.name, str(download.layer), reason, str(root)))
    return kept, misplaced


def _bridges(
    root: Path, downloads: Sequence[Download], derived: Path | None
) -> tuple[list[RasterFile], list[str], list[Skipped]]:
    """Return rasters of the bridge decks in the point clouds, newest first, notes, and clouds left out."""
    clouds = [download for download in downloads if download.layer is None]
    names = [download.path.relative_to(root).as_posix() for download in clouds]
    if not clouds:
        return [], [], []
    if derived is None:
        note = f"point clouds were not read, so the reference lacks the bridges in {some(names)}"
        return [], [note], []
    targets, unusable = list[Path](), list[Skipped]()
    for cloud in clouds:
        target = derived.resolve() / f"{cloud.path.stem}_bridges.tif"
        try:
            if _deck_raster(cloud.path, target, cloud.square, CRS):
                targets.append(target)
        except CatalogError as error:
            unusable.append(Skipped(str(cloud.path), "", str(error)))
    files, skipped = opened(root, "bridges", targets, CRS)
    return files, [], [*unusable, *skipped]


def _deck_raster(cloud: Path, target: Path, square: Bounds, crs: str) -> bool:
    """Write the mean height of a cloud's bridge points per cell (float32, NaN elsewhere).

    Return whether it has bridge points. An undamaged target that is not older than the cloud is kept.
    """
    if is_current(cloud, target):
        with open_raster(target) as raster:
            return bool(np.isfinite(raster.read(1)).any())
    west, south, east, north = square
    width, height = math.ceil((east - west) / DECK_CELL_M), math.ceil((north - south) / DECK_CELL_M)
    total, count = np.zeros(width * height), np.zeros(width * height, np.int64)
    for chunk in chunks(cloud):
        deck = chunk.kind == DECK
        x, y, z = chunk.x[deck], chunk.y[deck], chunk.z[deck]
        col, row = (
            np.floor((x - west) / DECK_CELL_M).astype(int),
            np.floor((north - y) / DECK_CELL_M).astype(int),
        )
        inside = (col >= 0) & (col < width) & (row >= 0) & (row < height)
        cell = row[inside] * width + col[inside]
        total += np.bincount(cell, z[inside], minlength=total.size)
        count += np.bincount(cell, minlength=count.size)
    with np.errstate(invalid="ignore"):
        heights = (total / count).reshape(height, width)
    write_heights(target, heights, Affine(DECK_CELL_M, 0, west, 0, -DECK_CELL_M, north), crs)
    return bool(count.any())
