"""Which tiles a run or a rerun is about."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from flexroad.catalog import Catalog, Tile
from flexroad.catalog.storage.paths import (
    Location,
    exists,
)
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.run.status import Folders
from flexroad.pipeline.store.records import FAILED


def rerun_filter(run: Run, tiles: Sequence[str], failed: bool) -> Callable[[Tile], bool]:
    """Return which tiles a rerun means: those named, those failed, both, or all.

    Raises
    ------
    CatalogError
        If a tile is not in the run's catalog.
    """
    folders = Folders(run.path)
    named = {tile.id for tile in run.catalog.select(tiles).tiles} if tiles else set()

    def chosen(tile: Tile) -> bool:
        if tile.id in named or not (named or failed):
            return True
        # Whatever it failed of: a file mended since is why it is tried again.
        return failed and FAILED in folders(tile.id)

    return chosen


def merged_catalog(path: Location, whole: Catalog, wanted: Catalog) -> Catalog:
    """Return the tiles a run is about when some tiles of a catalog are asked for.

    Those, and those it was asked for before that the catalog still has: their results stay in the tables.
    """
    record = path / "catalog.parquet"
    before = {tile.id for tile in Catalog.read(record).tiles} if exists(record) else set()
    known = before | {tile.id for tile in wanted.tiles}
    return Catalog(tuple(tile for tile in whole.tiles if tile.id in known))
