"""Ask a run for the ground under points.

>>> from flexroad.pipeline.inspect.points import Ground
>>> ground = Ground.open("RUN")                       # doctest: +SKIP
>>> ground.at(eastings, northings).height             # doctest: +SKIP
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TextIO

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from shapely import STRtree, box, points

from flexroad.catalog.storage.paths import Location, parse_location
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.graph.graph import TileGraph
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.run.status import peek_statuses
from flexroad.pipeline.store.artefacts import ArtefactStore
from flexroad.pipeline.worker.evaluator import Evaluator, StageError
from flexroad.tasks.types import Floats, RoadMask, Surface


@dataclass(frozen=True, eq=False)
class Answer:
    """What is known of n points; NaN and empty strings outside the run's tiles."""

    height: Floats
    """``(n,)``, m."""
    normal: Floats
    """``(n, 3)``, upward unit vectors: east, north, up."""
    tile: NDArray[np.str_]
    """``(n,)``, tile ids."""
    kind: NDArray[np.str_]
    """``(n,)``, ``road`` or ``terrain`` by the segmented mask."""


@dataclass(frozen=True, eq=False)
class Ground:
    """The fitted surfaces of a run's finished tiles as one ground.

    Surfaces come from the store; the sources are not needed for NURBS surfaces. Only the tiles under the
    points asked for are looked at.
    """

    run: Run
    variant: str

    @classmethod
    def open(cls, path: Location | str, variant: str | None = None) -> Ground:
        """Open a run.

        Raises
        ------
        ConfigError
            If it is no run, has no such variant, or no tile is done.
        """
        run = Run.open(parse_location(path))
        variant = variant or run.config.export.variants[0]
        if variant not in run.config.chains:
            raise ConfigError(f"{path} has no variant {variant!r}; it has {', '.join(run.config.chains)}")
        if not any(found.done for found in peek_statuses(run, run.catalog.tiles)):
            raise ConfigError(f"{path} has no finished tile; see `flexroad status {path}`")
        return cls(run, variant)

    def at(self, easting: Floats, northing: Floats) -> Answer:
        """Return height, normal, tile and class under n points (m, in the run's CRS).

        A point on the edge of two finished tiles belongs to the one first in the catalog.
        """
        easting = np.atleast_1d(np.asarray(easting, dtype=np.float64))
        northing = np.atleast_1d(np.asarray(northing, dtype=np.float64))
        height = np.full(easting.shape, np.nan)
        normal = np.full((*easting.shape, 3), np.nan)
        tile = np.zeros(easting.shape, dtype=object)
        kind = np.full(easting.shape, "", dtype=object)
        tile[:] = ""
        for graph, here in self._owners(easting, northing):
            surface, road = self._tile(graph)
            height[here] = surface.height(easting[here], northing[here])
            normal[here] = surface.normal(easting[here], northing[here])
            tile[here] = graph.tile.id
            kind[here] = np.where(
                road.mask[road.grid.cells(easting[here], northing[here])], "road", "terrain"
            )
        return Answer(height, normal, tile.astype(str), kind.astype(str))

    def _owners(self, easting: Floats, northing: Floats) -> Iterator[tuple[TileGraph, NDArray[np.intp]]]:
        """Yield each finished tile that has points, with their numbers."""
        tiles = self.run.catalog.tiles
        tree = STRtree([box(*tile.grid.bounds) for tile in tiles])
        point, number = tree.query(points(easting, northing), predicate="intersects")
        if not point.size:
            return
        order = np.argsort(number, kind="stable")
        under, starts = np.unique(number[order], return_index=True)
        free = np.ones(easting.shape, dtype=bool)
        stands = peek_statuses(self.run, [tiles[i] for i in under])
        for found, here in zip(stands, np.split(point[order], starts[1:]), strict=True):
            here = here[free[here]]
            if found.done and here.size:
                free[here] = False
                yield found.graph, here

    def _tile(self, graph: TileGraph) -> tuple[Surface, RoadMask]:
        pull = Evaluator(graph, ArtefactStore(self.run.store))
        made = graph.variants[self.variant]
        try:
            return pull(made["fit"]), pull(made["segment"])
        except StageError as error:
            raise ConfigError(f"tile {graph.tile.id}: {error}") from error


def query_csv(run: Location, csv: Path, variant: str | None, out: TextIO) -> int:
    """Answer a CSV of points with a CSV: its columns, then height_m, nx, ny, nz, tile, class.

    Returns
    -------
    int
        How many points lie on no finished tile.

    Raises
    ------
    ConfigError
        If the file is missing or lacks the columns easting and northing, or a value is no number.
    """
    try:
        table = pd.read_csv(csv)
        easting = table["easting"].to_numpy(np.float64)
        northing = table["northing"].to_numpy(np.float64)
    except KeyError as error:
        raise ConfigError(f"{csv}: no column {error}; it needs easting and northing (m)") from error
    except (OSError, ValueError) as error:
        raise ConfigError(f"{csv}: not readable as a table of points: {error}") from error
    answer = Ground.open(run, variant).at(easting, northing)
    table["height_m"] = answer.height
    for i, name in enumerate(("nx", "ny", "nz")):
        table[name] = answer.normal[:, i]
    table["tile"] = answer.tile
    table["class"] = answer.kind
    table.to_csv(out, index=False, float_format="%.9g")
    return int((answer.tile == "").sum())
