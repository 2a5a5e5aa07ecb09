"""Areas that select tiles: the polygons of a vector file."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import shapely

from flexroad.catalog.crs import transformer
from flexroad.catalog.errors import CatalogError
from flexroad.catalog.grid import Grid
from flexroad.catalog.guard.open_vector import ERRORS, in_its_encoding, vector_name
from flexroad.catalog.guard.source_files import InputRejected
from flexroad.catalog.lazy import lazy
from flexroad.catalog.scan.vectors import file_and_layer, one_layer
from flexroad.catalog.text import reason

pyogrio = lazy("pyogrio")

TOUCH_M = 1e-3
"""Least overlap of a tile and an area (m): an area that ends on the edge of a tile does not touch it."""
STEPS = 8
"""Number of parts into which a tile's side is divided: it is curved in the CRS of the area."""


@dataclass(frozen=True, eq=False)
class Area:
    """Polygons that tiles may lie on."""

    name: str
    """The file, for messages."""
    crs: str
    polygons: Any
    """Polygons of shapely in the CRS, ``(n,)``."""

    @classmethod
    def read(cls, given: Path | str) -> Area:
        """Read the polygons of a vector file.

        - `given`: GeoPackage, GeoJSON, FlatGeobuf or Shapefile; with a layer as in `file_and_layer`.
        """
        path, layer = file_and_layer(given)
        try:
            name = vector_name(path)
            layer = one_layer(f"--area {path}", path, layer)
            read = partial(pyogrio.read_dataframe, name, layer=layer, columns=[])
            table = in_its_encoding(read)[0] if layer else None
        except InputRejected as error:
            raise CatalogError(f"--area {path} {error}") from error
        except ERRORS as error:
            raise CatalogError(f"--area {path} cannot be read: {reason(error)}") from error
        shapes = np.empty(0) if table is None else shapely.force_2d(np.asarray(table.geometry))
        polygons = shapes[np.isin(shapely.get_type_id(shapes), (3, 6)) & ~shapely.is_empty(shapes)]
        if table is None or not polygons.size:
            raise CatalogError(f"--area {path} has no polygons; draw the area as polygons")
        if table.crs is None:
            raise CatalogError(f"--area {path} has no CRS; add it with ogr2ogr -a_srs EPSG:N NEW {path.name}")
        try:
            return cls(str(path), table.crs.to_wkt(), shapely.make_valid(polygons))
        except shapely.errors.ShapelyError as error:
            raise CatalogError(f"--area {path} has polygons that cannot be used: {reason(error)}") from error

    def touched(self, grids: Iterable[Grid]) -> list[bool]:
        """Return for each grid whether its bounds and a polygon overlap.

        Tiles are transformed to the CRS of the area, as its sides are straight there.
        """
        tree = shapely.STRtree(self.polygons)
        return [bool(tree.query(self._outline(grid), predicate="intersects").size) for grid in grids]

    def _outline(self, grid: Grid) -> Any:
        """Return the outline of a grid in the CRS of the area; empty if it cannot be transformed."""
        west, south, east, north = grid.bounds
        box = shapely.box(west + TOUCH_M, south + TOUCH_M, east - TOUCH_M, north - TOUCH_M)
        corners = shapely.get_coordinates(shapely.segmentize(box, max(east - west, north - south) / STEPS))
        x, y = transformer(grid.crs, self.crs).transform(*corners.T)
        return shapely.polygons(np.column_stack([x, y])) if np.isfinite([x, y]).all() else shapely.Polygon()
