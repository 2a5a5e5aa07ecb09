"""Check of a catalog: layers per tile, expected failures, shift of the photo, and decks without a level.

A deck is level road above the DTM that continues as a street of the same height. The decks are written to a
map, ``decks.geojson``, for the user to check.
"""

from __future__ import annotations

import json
import math
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
import scipy
import shapely
from numpy.typing import NDArray
from pyproj.exceptions import ProjError

from flexroad.catalog import LAYERS, Catalog, Tile
from flexroad.catalog.crs import short, transformer
from flexroad.catalog.grid import Grid
from flexroad.catalog.index import check_allowed
from flexroad.catalog.lazy import lazy
from flexroad.catalog.scan.cell_values import plateau_notes
from flexroad.catalog.storage.paths import Location, exists, read, remove, write
from flexroad.catalog.text import count, write_reason
from flexroad.catalog.tile import HEIGHTS
from flexroad.pipeline.check.failures import expected_failures
from flexroad.pipeline.check.trial import Finding, evenly
from flexroad.pipeline.config.models import Config
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.graph.layers import check_layers
from flexroad.tasks import load
from flexroad.tasks.errors import TaskError
from flexroad.tasks.io.orthophoto import read_photo
from flexroad.tasks.io.vectors import Query, read_near
from flexroad.tasks.options import Options
from flexroad.tasks.roads import attributes, coregistration, rasterise
from flexroad.tasks.roads.flat_patches import flat_cells
from flexroad.tasks.types import Bools, Floats, TileData

rasterio = lazy("rasterio")

MAX_PHOTO_TILES = 12
"""Number of tiles whose photo is compared with the heights, spread evenly over the catalog."""
FILE = "decks.geojson"
MAKER = {"generator": "flexroad catalog check"}
"""Members of the map that other programs do not write: a file without them is not replaced."""
MOST_TILES = 200
"""Number of tiles searched for decks, spread evenly over the catalog, unless all are requested."""
LEAST_HALO_M = 50.0
"""Width of the ground around a tile that is read (m), so that decks across its border are complete."""
RISE_M, AREA_M2 = 1.5, 20.0
"""Least height above the DTM (m) and least area (m2) of a deck."""
ROUGHNESS_M, BEND = 0.15, 0.1
"""Limits of flat patches, as in ``ecsrc: planar``."""
STREET_M = 0.5
"""Largest difference of DSM and DTM on a street (m)."""
END_M, END_M2 = 6.0, 4.0
"""A deck ends at a street of at least this area within this distance."""
STEP_M, GRADE = 0.5, 0.1
"""Largest height difference between a deck and the street at its end: a step (m), and a slope (m/m)."""
GAP_M = 1.5
"""Places of streets that are closer to each other than this are one end (m)."""
ENDS = 2
"""A place with fewer ends may also be a roof."""
EVERY_WAY = np.ones((3, 3), bool)


@dataclass(frozen=True, eq=False)
class Deck:
    """A place that looks like a deck."""

    area: shapely.Geometry
    """Outline of its flat cells."""
    rise_m: float
    """Median height above the DTM."""
    ends: int
    """Number of places where a street of the same height continues."""

    @property
    def is_sure(self) -> bool:
        """Whether it cannot be a roof."""
        return self.ends >= ENDS


def check(catalog: Catalog, config: Config, path: Path, every_deck: bool = False) -> Iterator[Finding]:
    """Yield the contents of a catalog, expected failures with a configuration, and decks without a level.

    - `path`: file of the catalog: the map of decks is written next to it (`deck_findings`).
    - `every_deck`: whether to look for decks on all tiles of a large catalog.
    """
    check_allowed(catalog)
    tiles = catalog.usable
    sizes = Counter(f"{tile.grid.width}x{tile.grid.height} at {tile.grid.cell:g} m" for tile in tiles)
    systems = sorted({short(tile.grid.crs) for tile in tiles})
    yield Finding(f"{count(len(tiles), 'tile')} of {', '.join(sizes)}; {', '.join(systems)}")
    counts = {name: sum(tile.layer(name) is not None for tile in tiles) for name in LAYERS}
    yield Finding("tiles with " + ", ".join(f"{name}: {number}" for name, number in counts.items() if number))
    try:
        check_layers(config, catalog)
    except ConfigError as error:
        yield Finding(f"a run would not start: {error}", fault=True)
    yield from expected_failures(catalog.tiles, config, LAYERS)
    yield from _plateaus(tiles)
    yield from _photos([tile for tile in tiles if tile.layer("dop")])
    yield from deck_findings(tiles, config, path, every_deck)


def _plateaus(tiles: Sequence[Tile]) -> Iterator[Finding]:
    """Name the files of heights in which many cells have one exact value."""
    files: dict[str, dict[str, Location]] = defaultdict(dict)
    for tile in tiles:
        for layer in (layer for layer in tile.layers if layer.name in HEIGHTS):
            files[layer.name].update(zip(layer.files, tile.paths(layer), strict=True))
    for name in (name for name in HEIGHTS if name in files):
        for note in plateau_notes(name, files[name]):
            yield Finding(note)


def _photos(tiles: Sequence[Tile]) -> Iterator[Finding]:
    """Compare photos with heights on a sample of the tiles that have the most frequent cell size."""
    tiles = [tile for tile in tiles if coregistration.large_enough(tile.grid)]
    cells = Counter(tile.grid.cell for tile in tiles)
    tiles = [tile for tile in tiles if tile.grid.cell == cells.most_common(1)[0][0]]
    sample = evenly(tiles, MAX_PHOTO_TILES)
    pairs: list[coregistration.Pair] = []
    for tile in sample:
        try:
            data = load.load(tile, load.Options(min_valid=0.0))
            assert data.dop is not None  # the caller selects tiles with a photo
            pairs.append(coregistration.pair(data, read_photo(data.dop, data.grid)))
        except TaskError as error:
            yield Finding(f"{tile.id}: {error}", fault=True)
    if pairs:
        yield _shift(pairs, sample[0].grid.cell)


def _shift(pairs: Sequence[coregistration.Pair], cell: float) -> Finding:
    shift = coregistration.shift(pairs)
    tile_shifts = [coregistration.shift([pair], shift.sun) for pair in pairs]
    scatter = median(
        ((tile.east_m - shift.east_m) ** 2 + (tile.north_m - shift.north_m) ** 2) ** 0.5
        for tile in tile_shifts
    )
    measured = (
        f"{shift} of the heights (over {count(len(pairs), 'tile')}, half of them within "
        f"{scatter:.1f} m of that; sun at {shift.sun[0]:.0f}°, {shift.sun[1]:.0f}° high; "
        f"confidence {shift.confidence:.2f})"
    )
    if not coregistration.matters(shift, cell, scatter):
        return Finding(f"dop: {measured}: no significant shift")
    if shift.confidence < coregistration.CLEAR:
        line = f"dop seems to lie {measured}: too unclear to move it; compare it with the heights in a GIS"
        return Finding(line, warning=True)
    return Finding(
        f"dop lies {measured}: move it, e.g. with gdal_translate -a_ullr, before it is used with them",
        fault=True,
    )


def deck_findings(tiles: Sequence[Tile], config: Config, catalog: Path, every: bool) -> Iterator[Finding]:
    """Yield the number of decks without a level; if all tiles were searched, write them next to the catalog.

    An older map is replaced, or removed if no deck is found, unless another program has changed it.

    - `tiles`: usable tiles.
    - `config`: configuration of the run: its first chain has the roads.
    - `catalog`: file of the catalog.
    - `every`: whether to search all tiles, not only `MOST_TILES`.
    """
    chain = next(iter(config.chains.values()))
    tiles = [tile for tile in tiles if tile.layer("road_mask") or tile.layer("roads")]
    sample = tiles if every else evenly(tiles, MOST_TILES)
    found = [(tile, deck) for tile in sample for deck in _decks(tile, chain["load"], chain["segment"])]
    if len(sample) < len(tiles):
        if found:
            yield Finding(f"{_told(found)}, on {len(sample)} of {len(tiles)} tiles: look at all with --decks")
    elif tiles:
        yield from _written(catalog.parent / FILE, found)


def _told(found: Sequence[tuple[Tile, Deck]]) -> str:
    sure = sum(deck.is_sure for _, deck in found)
    kinds = [(sure, "like decks"), (len(found) - sure, "like decks or roofs")]
    first, *others = [(number, kind) for number, kind in kinds if number]
    places = f"{count(first[0], 'place')} look{'s' * (first[0] == 1)} {first[1]}"
    return "".join(
        [places, *(f", {number} {kind}" for number, kind in others), "; no road there has a level"]
    )


def _written(path: Path, found: Sequence[tuple[Tile, Deck]]) -> Iterator[Finding]:
    """Write the map of decks; yield the line on them."""
    try:
        is_old = exists(path)
        if is_old and not _is_own(path):
            if found:
                remedy = "rename it, and check again"
                yield Finding(f"{_told(found)}; {path} was edited and is not replaced: {remedy}")
        elif found:
            write(path, _map(found))
            yield Finding(f"{_told(found)}: check {path}, then give roads there a level")
        elif is_old:
            remove(path)
    except ProjError:
        yield Finding(f"{_told(found)}; no map of them, as their CRS has no place on the Earth")
    except OSError as error:
        remedy = "check a copy of the catalog in a folder that can be written"
        yield Finding(f"{_told(found)}; {path} cannot be written ({write_reason(error)}): {remedy}")


def _is_own(path: Path) -> bool:
    """Return whether a file is an unchanged map of decks."""
    try:
        content = json.loads(read(path))
    except ValueError:
        return False
    return isinstance(content, dict) and MAKER.items() <= content.items()


def _map(found: Sequence[tuple[Tile, Deck]]) -> bytes:
    """Return decks as GeoJSON, in degrees."""
    features = [
        {
            "type": "Feature",
            "properties": _properties(tile, deck),
            "geometry": json.loads(shapely.to_geojson(_in_degrees(tile, deck))),
        }
        for tile, deck in found
    ]
    return json.dumps({"type": "FeatureCollection", **MAKER, "features": features}, indent=1).encode()


def _properties(tile: Tile, deck: Deck) -> dict[str, Any]:
    return {
        "level": 1,
        "kind": "deck" if deck.is_sure else "deck or roof",
        "rise_m": round(deck.rise_m, 2),
        "area_m2": round(deck.area.area, 1),
        "ends": deck.ends,
        "tile": tile.id,
    }


def _in_degrees(tile: Tile, deck: Deck) -> shapely.Geometry:
    to_degrees = transformer(tile.grid.crs, "EPSG:4326").transform
    degrees = shapely.transform(deck.area, lambda xy: np.column_stack(to_degrees(*xy.T)))
    return shapely.set_precision(degrees, 1e-8)


def _decks(tile: Tile, reading: load.Options, selection: Options) -> list[Deck]:
    """Return the decks of a tile without a level; empty if the tile cannot be read."""
    options = selection if isinstance(selection, rasterise.Options) else rasterise.DEFAULTS
    reading = reading.model_copy(update={"halo_m": max(reading.halo_m, LEAST_HALO_M), "min_valid": 0.0})
    try:
        data = load.load(tile, reading)
        road = data.road_mask if options is not selection else None
        if road is None and data.roads is not None:
            road = rasterise.rasterise_roads(data, options)
        if road is None:
            return []
        decks = likely_decks(data.dsm, data.dtm, road, data.grid)
        named = _named(data, options) if decks else np.empty(0, object)
    except TaskError:
        # A tile that cannot be read is reported by another finding.
        return []
    west, south, east, north = data.core.bounds
    # A deck in several tiles belongs to the tile with its centre.
    return [
        deck
        for deck in decks
        if west <= (centre := deck.area.centroid).x < east
        and south <= centre.y < north
        and not shapely.intersects(named, deck.area).any()
    ]


def _named(data: TileData, options: rasterise.Options) -> NDArray[np.object_]:
    """Return the roads of a tile above level 0 as areas, ``(n,)``; empty without vectors."""
    source = data.roads
    if source is None:
        return np.empty(0, object)
    shapes, layer, names = [], options.layer or source.sublayer, attributes.LEVEL_COLUMNS
    for path in source.paths:
        table = read_near(
            Query(path, layer, options.where, names, source.crs, data.grid.crs), data.grid.bounds
        )
        numbers, _ = attributes.level_numbers(table)
        shapes.append(table.geometry.to_numpy()[numbers > 0])
    areas: NDArray[np.object_] = shapely.buffer(np.concatenate(shapes), options.default_width_m / 2)
    return areas


def likely_decks(dsm: Floats, dtm: Floats, road: Bools, grid: Grid) -> list[Deck]:
    """Return the places of road that look like decks.

    - `dsm`, `dtm`: heights (m), NaN where unknown.
    - `road`: cells of roads, also on decks.
    - `grid`: the grid of all arrays.
    """
    points = road & np.isfinite(dsm)
    flat = flat_cells(dsm, points, grid.cell, ROUGHNESS_M, BEND) & points
    rise = dsm - dtm
    street = flat & (np.abs(rise) <= STREET_M)
    parts, number = scipy.ndimage.label(flat & (rise > RISE_M), EVERY_WAY)
    sizes = np.bincount(parts.ravel(), minlength=number + 1) * grid.cell**2
    decks = []
    for k, box in enumerate(scipy.ndimage.find_objects(parts), 1):
        if sizes[k] >= AREA_M2:
            # Only cells near the deck are used: a tile may have millions of cells.
            around = _grown(box, math.ceil(END_M / grid.cell) + 1, road.shape)
            own, here = parts[around] == k, grid.part(*around)
            ends = _ends(own, street[around], dsm[around], grid.cell)
            decks.append(Deck(_outline(own, here), float(np.median(rise[around][own])), ends))
    return decks


def _grown(box: tuple[slice, ...], cells: int, shape: tuple[int, ...]) -> tuple[slice, slice]:
    """Return the rows and columns of a box, extended by a number of cells on each side."""
    rows, cols = (
        slice(max(side.start - cells, 0), min(side.stop + cells, length))
        for side, length in zip(box, shape, strict=True)
    )
    return rows, cols


def _ends(own: Bools, street: Bools, dsm: Floats, cell: float) -> int:
    """Return the number of streets of the same height within `END_M` of a deck's cells."""
    away, nearest = scipy.ndimage.distance_transform_edt(~own, sampling=cell, return_indices=True)
    off = np.abs(dsm - dsm[tuple(nearest)])
    level = street & (away <= END_M) & (off <= STEP_M + GRADE * away)
    grown = scipy.ndimage.binary_dilation(level, iterations=max(1, round(GAP_M / cell)))
    places, _ = scipy.ndimage.label(grown)
    sizes = np.bincount(places[level], minlength=1) * cell**2
    return int((sizes[1:] >= END_M2).sum())


def _outline(cells: Bools, grid: Grid) -> shapely.Geometry:
    """Return the simplified outline of cells, without the steps from cell to cell."""
    shapes = rasterio.features.shapes(cells.astype(np.uint8), mask=cells, transform=grid.transform)
    outline = shapely.union_all([shapely.geometry.shape(shape) for shape, _ in shapes])
    return shapely.simplify(outline, grid.cell)
