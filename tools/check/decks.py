"""Decks on a catalog's tiles that no road names, and the map of them to be checked: ``decks.geojson``."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray
from pyproj.exceptions import ProjError

from flexroad.catalog import Tile
from flexroad.catalog.crs import transformer
from flexroad.catalog.storage.paths import exists, read, remove, write
from flexroad.catalog.text import count, write_reason
from flexroad.pipeline.check.finding import Finding, evenly
from flexroad.pipeline.config.models import Config
from flexroad.tasks import load
from flexroad.tasks.errors import TaskError
from flexroad.tasks.io.vectors import Query, read_near
from flexroad.tasks.options import Options
from flexroad.tasks.quality.decks import Deck, likely_decks
from flexroad.tasks.roads import level_numbers, rasterise
from flexroad.tasks.types import TileData

FILE = "decks.geojson"
MAKER = {"generator": "flexroad catalog check"}
"""Members of the file that editors leave out when they write it: such a file is not replaced."""
MOST_TILES = 200
"""Number of tiles that are looked at, spread evenly over the catalog, unless all are asked for."""
LEAST_HALO_M = 50.0
"""Ground around a tile that is read: a deck that reaches beyond the tile is seen as a whole (m)."""


def deck_findings(tiles: Sequence[Tile], config: Config, catalog: Path, every: bool) -> Iterator[Finding]:
    """Yield how many decks no road names, and write them beside the catalog if all tiles were looked at.

    An older map is replaced, or removed if there are none, unless another program has written it since.

    - `tiles`: usable tiles.
    - `config`: configuration of the run: its first chain has the roads.
    - `catalog`: file of the catalog.
    - `every`: whether to look at all tiles, not at `MOST_TILES` at most.
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
    """Yield the line on some decks, and write their map."""
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
    """Return whether a file is a map of decks as it was written."""
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
    """Return the decks of a tile that no road names; none if the tile cannot be read."""
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
        # What a run could not read has a line of its own.
        return []
    west, south, east, north = data.core.bounds
    # A deck that reaches into several tiles is that of the one with its centre.
    return [
        deck
        for deck in decks
        if west <= (centre := deck.area.centroid).x < east
        and south <= centre.y < north
        and not shapely.intersects(named, deck.area).any()
    ]


def _named(data: TileData, options: rasterise.Options) -> NDArray[np.object_]:
    """Return the roads of a tile that are above level 0, as areas, ``(n,)``; none without vectors."""
    source = data.roads
    if source is None:
        return np.empty(0, object)
    shapes, layer, names = [], options.layer or source.sublayer, level_numbers.COLUMNS
    for path in source.paths:
        table = read_near(
            Query(path, layer, options.where, names, source.crs, data.grid.crs), data.grid.bounds
        )
        numbers, _ = level_numbers.level_numbers(table)
        shapes.append(table.geometry.to_numpy()[numbers > 0])
    areas: NDArray[np.object_] = shapely.buffer(np.concatenate(shapes), options.default_width_m / 2)
    return areas
