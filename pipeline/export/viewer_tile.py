"""What the browser viewer shows of one tile: mesh with photo, surface, rasters and road lines."""

from __future__ import annotations

import base64
from dataclasses import dataclass, replace

import numpy as np

from flexroad.catalog import Tile
from flexroad.catalog.crs import transformer
from flexroad.catalog.ids import safe_name
from flexroad.catalog.lazy import lazy
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.export.pieces import Piece
from flexroad.pipeline.export.source import OfTile, layer_state
from flexroad.pipeline.worker.texture import tile_photo
from flexroad.tasks.errors import TaskError
from flexroad.tasks.export import glb, viewer
from flexroad.tasks.load import layer_source
from flexroad.tasks.roads.centre_lines import read_centre_lines
from flexroad.tasks.roads.rasterise import DEFAULTS
from flexroad.tasks.roads.rasterise import Options as RoadOptions
from flexroad.tasks.roads.routes import CentreLine
from flexroad.tasks.spline.surface import NurbsSurface
from flexroad.tasks.types import Floats

shapely = lazy("shapely")

WGS84 = "EPSG:4326"
QUALITY = 82
"""Quality of the photos' JPEG."""
SIMPLIFIED_M = 0.05
"""Largest distance of a simplified road line from the given one (m)."""


@dataclass(frozen=True)
class Look:
    """Options of the tiles' scripts."""

    origin: tuple[float, float]
    """Whole-metre (easting, northing) that meshes of the run are relative to."""
    photo_px: int
    """Largest width and height of a photo (pixels)."""
    roads: RoadOptions = DEFAULTS
    """Selection of the road lines."""


@dataclass(frozen=True, eq=False)
class Shown(OfTile):
    """A finished tile with its photo and road lines."""

    @property
    def fingerprint(self) -> str:
        """Name of its script by what it is made of."""
        layers = (layer_state(self.tile.tile, name) for name in ("dop", "roads"))
        return " ".join((self.tile.snapshot.nodes["assess"], *layers))


def piece(item: Shown, look: Look) -> Piece:
    """Return the script of a tile; its row has its picture, and names what could not be read."""
    tile = item.tile
    source, notes = tile.tile, list[str]()
    photo = _photo(source, look.photo_px, notes)
    quality, surface = tile.quality, tile.surface
    try:
        data, (estimate, _) = tile.data, tile.cell_errors
    except ConfigError as error:
        dsm = dtm = estimate = None
        seen = ""
        notes.append(f"no scan and terrain model to compare with: {error}")
    else:
        window = data.grid.window(data.core)
        dsm, dtm = data.dsm[window], data.dtm[window]
        height = surface.lattice(data.core.eastings, data.core.northings)
        height[tile.road.outside[window]] = np.nan
        small = viewer.picture(height, tile.road.mask[window], data.core.cell)
        seen = base64.b64encode(small).decode("ascii")
    scene = viewer.TileScene(
        tile.id,
        glb.encode(tile.mesh, (*look.origin, 0.0), photo, surface),
        source.grid,
        corners(source),
        quality.support,
        dsm,
        dtm,
        estimate,
        surface if isinstance(surface, NurbsSurface) else None,
        _lines(source, look.roads, notes),
    )
    name = f"tiles/{safe_name(tile.id)}{viewer.NAME_TILE}"
    return Piece({name: viewer.encode_tile(scene)}, {"tile": tile.id, "notes": notes, "picture": seen})


def corners(tile: Tile) -> Floats:
    """Return longitude and latitude of a tile's corners, ``(4, 2)``: SW, SE, NW, NE (degrees)."""
    west, south, east, north = tile.grid.bounds
    places = transformer(tile.grid.crs, WGS84).transform(
        [west, east, west, east], [south, south, north, north]
    )
    return np.column_stack(places)


def _photo(tile: Tile, largest_px: int, notes: list[str]) -> glb.Texture | None:
    layer = tile.layer("dop")
    layer = layer and layer.reaching(tile.grid.bounds)
    if not layer:
        return None
    try:
        photo = tile_photo(tile, layer, largest_px)
    except TaskError as error:
        notes.append(f"no photo: {error}")
        return None
    return glb.texture(photo, QUALITY) if photo else None


def _lines(tile: Tile, options: RoadOptions, notes: list[str]) -> tuple[CentreLine, ...]:
    """Return the centre lines of the catalog on a tile, cut at its edges."""
    layer = tile.layer("roads")
    source = layer and layer_source(replace(tile, layers=(layer,)), layer.name)
    if not source:
        return ()
    bounds = tile.grid.bounds
    try:
        lines = read_centre_lines(source, bounds, tile.grid.crs, options).lines
    except TaskError as error:
        notes.append(f"no road lines: {error}")
        return ()
    parts = []
    for line in lines:
        cut = shapely.LineString(line.points).simplify(SIMPLIFIED_M).intersection(shapely.box(*bounds))
        for part in shapely.get_parts(cut):
            if part.geom_type == "LineString" and part.length > 0:
                parts.append(replace(line, points=shapely.get_coordinates(part)))
    return tuple(parts)
