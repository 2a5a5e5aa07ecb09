"""Selection of the tiles of a run or rerun."""

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
    """Return a filter for the tiles of a rerun: the given tiles, the failed ones, both, or all.

    Raises
    ------
    CatalogError
        If a tile is not in the run's catalog.
    """
    folders = Folders(run.path)
    ids = {tile.id for tile in run.catalog.select(tiles).tiles} if tiles else set()

    def selected(tile: Tile) -> bool:
        if tile.id in ids or not (ids or failed):
            return True
        # The marker is enough, even if it is of other sources: a corrected file is a reason to rerun.
        return failed and FAILED in folders(tile.id)

    return selected


def merged_catalog(path: Location, whole: Catalog, wanted: Catalog) -> Catalog:
    """Return the tiles of the run at ``path`` when the tiles ``wanted`` of a catalog are requested.

    They are those tiles and the earlier tiles of the run that are still in the catalog, so that the results
    of these stay in the tables.
    """
    record = path / "catalog.parquet"
    earlier = {tile.id for tile in Catalog.read(record).tiles} if exists(record) else set()
    ids = earlier | {tile.id for tile in wanted.tiles}
    return Catalog(tuple(tile for tile in whole.tiles if tile.id in ids))
