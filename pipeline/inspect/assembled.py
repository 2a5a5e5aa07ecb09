"""One surface of many tiles: their control points put together on their common lattice."""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

import numpy as np

from flexroad.catalog import Bounds, Tile
from flexroad.catalog.grid import overlap
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.graph.borders import has_borders
from flexroad.pipeline.inspect.surface import Surface
from flexroad.pipeline.run.finished import FinishedTile
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.run.status import peek_statuses
from flexroad.tasks import sample
from flexroad.tasks.spline.surface import NurbsSurface, uniform_knots


def assembled(run: Run, variant: str, bounds: Bounds | None) -> Surface:
    """Return the surface of the finished tiles in the bounds (m); None for all tiles.

    Raises
    ------
    ConfigError
        If the variant's tiles have no common lattice, none of them is finished, or they are of different CRS.
    """
    fit = run.config.chains[variant]["fit"]
    if not has_borders(fit):
        raise ConfigError(
            f"{run.path}: the tiles of {variant} have no common surface; fit.method smoothing_spline makes "
            "one. The heights of single tiles are in open_run(...).height"
        )
    tiles = [tile for tile in run.catalog.usable if bounds is None or overlap(tile.grid.bounds, bounds)]
    done = [status for status in peek_statuses(run, tiles) if status.done]
    if not done:
        raise ConfigError(
            f"{run.path} has no finished tile in {bounds or 'its catalog'}; see `flexroad status`"
        )
    surfaces = [FinishedTile.of(run, status, variant).surface for status in done]
    whole = _joined([status.graph.tile for status in done], cast("list[NurbsSurface]", surfaces))
    west, south, east, north = whole.bounds
    if bounds is not None:
        west, south = max(west, bounds[0]), max(south, bounds[1])
        east, north = min(east, bounds[2]), min(north, bounds[3])
    return Surface(whole, whole.crs, (west, south, east, north), None, None, sample.Options(), "")


def _joined(tiles: Sequence[Tile], surfaces: Sequence[NurbsSurface]) -> NurbsSurface:
    """Return one surface over the rectangle around the tiles; NaN where it has no tile."""
    first = tiles[0].grid
    if len({tile.grid.crs for tile in tiles}) > 1:
        raise ConfigError("the tiles are in different CRS; give bounds with tiles of one CRS")
    width, height = first.width * first.cell, first.height * first.cell
    edges = np.array([tile.grid.bounds for tile in tiles])
    (west, south), (east, north) = edges[:, :2].min(axis=0), edges[:, 2:].max(axis=0)
    p, q = surfaces[0].degree
    n, m = surfaces[0].A.shape[1] - p, surfaces[0].A.shape[0] - q
    columns, rows = round((east - west) / width), round((north - south) / height)
    heights = np.full((rows * m + q, columns * n + p), np.nan)
    for tile, surface in zip(tiles, surfaces, strict=True):
        j, i = round((tile.grid.south - south) / height) * m, round((tile.grid.west - west) / width) * n
        # Points on the border are in both tiles; those of a missing neighbour stay.
        heights[j : j + m + q, i : i + n + p] = surface.A
    return NurbsSurface(
        crs=first.crs,
        bounds=(float(west), float(south), float(east), float(north)),
        degree=(p, q),
        knots_u=uniform_knots(0, columns * n, p),
        knots_v=uniform_knots(0, rows * m, q),
        A=heights,
        W=np.ones_like(heights),
        datum=surfaces[0].datum,
        origin=(float(np.floor(west)), float(np.floor(south))),
    )
