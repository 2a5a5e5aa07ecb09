"""Input of an export: the finished tiles of a run, with their surfaces and meshes, and the options."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from flexroad.catalog import Bounds, Tile
from flexroad.catalog.area import Area
from flexroad.catalog.guard.source_files import source_stat
from flexroad.catalog.storage.paths import Location
from flexroad.pipeline.config.options import INPUTS, OUTPUTS, option
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.run.finished import (
    COMPUTED_AGAIN,
    FinishedTile,
    RunPlace,
    Snapshot,
    file_states,
    snapshots,
)
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.run.status import Track, untracked
from flexroad.pipeline.worker.evaluator import SourceChanged
from flexroad.pipeline.worker.exports import tile_texture
from flexroad.tasks.io.dsm_and_dtm import vertical_crs
from flexroad.tasks.metrics.evaluate import FIGURES
from flexroad.tasks.products.glb import Texture
from flexroad.tools.export.georeference import Datum, Georeference


@dataclass(frozen=True)
class Options:
    """Options of an export."""

    datum: Datum | None = None
    """How heights become heights above the ellipsoid; needed by formats with WGS 84."""
    compress: bool = option(False, OUTPUTS, "Compress LandXML.", name="gzip")
    resolution_m: float | None = option(
        None, OUTPUTS, "Cell size of mosaic; default: the cell size of the run.", "METRES", min=0.01
    )
    level: int | None = option(
        None, OUTPUTS, "Level of mosaic: 0 is the ground, also below decks; default: the highest.", "N"
    )
    drape: bool = option(False, OUTPUTS, "Put the orthophoto on the meshes of 3dtiles and obj.")
    """Also if the meshes of the run have no orthophoto."""
    roads: str | None = option(
        None,
        INPUTS,
        "Centre lines for crg, xodr and lines, FILE|layername=NAME for one layer; default: the catalog's.",
        "FILE",
    )
    left_hand: bool = option(False, INPUTS, "Traffic keeps left, for xodr.")
    formats: frozenset[str] = frozenset()
    """Names of the formats that are written together; some refer to files of other formats."""


def layer_state(tile: Tile, name: str) -> str:
    """Return the files of a tile's layer with their sizes and versions; empty if the tile has none."""
    layer = tile.layer(name)
    reaching = layer.reaching(tile.grid.bounds) if layer else None
    return str([(str(path), source_stat(path)) for path in tile.paths(reaching)]) if reaching else ""


@dataclass(frozen=True, eq=False)
class Source:
    """The finished tiles of a run that an export contains."""

    run: Run
    variant: str
    tiles: tuple[Tile, ...]
    """In the order of the catalog."""
    left_out: tuple[str, ...]
    """Ids of selected tiles that are not finished."""
    snapshots: tuple[Snapshot, ...]
    """The state of each tile when the tiles were selected."""

    @property
    def crs(self) -> str:
        """The horizontal CRS of all tiles."""
        return self.tiles[0].grid.crs

    @cached_property
    def vertical(self) -> str | None:
        """The vertical CRS of the heights, by the files of the first tile; None if unknown."""
        return vertical_crs(self.tiles[0])

    @property
    def mesh_distances(self) -> dict[str, float]:
        """The largest distances of the meshes from their surfaces (m), by column of metrics.parquet."""
        known = np.fmax.reduce([snapshot.distances for snapshot in self.snapshots])
        return {
            name: value for name, value in zip(FIGURES, known.tolist(), strict=True) if np.isfinite(value)
        }

    @property
    def place(self) -> Georeference:
        """Origin of local coordinates in files: the run's origin, at the height 0."""
        return Georeference(self.crs, (*self.run.origin, 0.0), self.vertical)

    def finished(self) -> Iterator[FinishedTile]:
        """Yield the tiles one by one, checked to be unchanged since they were selected.

        Only sizes and times of their files are compared: this is fast, and each format reads all tiles.
        """
        state, place = file_states(self.run), RunPlace.of(self.run)
        for tile, before in zip(self.tiles, self.snapshots, strict=True):
            current = before if state(tile) == before.files else self._checked(tile, before)
            yield FinishedTile(tile, self.variant, current, place)

    def _checked(self, tile: Tile, before: Snapshot) -> Snapshot:
        """Return the snapshot of a tile with a file whose size or time has changed."""
        ((_, current),) = snapshots(self.run, [tile], self.variant)
        if current is None:
            raise ConfigError(
                f"{self.run.path}: tile {tile.id} is no longer finished; "
                f"run `flexroad rerun {self.run.path}`, then export again"
            )
        if current.fingerprint != before.fingerprint:
            raise ConfigError(f"tile {tile.id}: {COMPUTED_AGAIN}")
        return current


def select(
    location: Location,
    ids: Sequence[str] = (),
    bbox: Bounds | None = None,
    allow: Sequence[str] = (),
    area: Area | None = None,
    track: Track = untracked,
) -> Source:
    """Return the finished tiles of a run, among all or the selected tiles.

    The state of each selected tile is checked here, once for all formats.

    - `track`: shows the progress of this check.
    """
    run = Run.open(location, allow)
    variant = run.config.export.variants[0]
    wanted = run.catalog.select(ids, bbox, area).tiles
    checked = track(snapshots(run, wanted, variant), "checking tiles", len(wanted))
    done = {tile.id: snapshot for tile, snapshot in checked if snapshot}
    tiles = tuple(tile for tile in wanted if tile.id in done)
    if not tiles:
        raise ConfigError(f"{location} has no finished tile to export; see `flexroad status {location}`")
    systems = {tile.grid.crs for tile in tiles}
    if len(systems) > 1:
        raise ConfigError(f"{location} has tiles in {len(systems)} CRSs; select tiles of one CRS with --bbox")
    left_out = tuple(tile.id for tile in wanted if tile.id not in done)
    return Source(run, variant, tiles, left_out, tuple(done[tile.id] for tile in tiles))


def texture_of(tile: FinishedTile) -> Texture | None:
    """Return the photo of a tile, also if the products of its run have no photo; None without a photo."""
    pattern = tile.place.pattern
    with_photo = replace(pattern, export=pattern.export.model_copy(update={"texture": True}))
    try:
        return tile_texture(with_photo.graph(tile.tile, tile.place.checksum))[0]
    except SourceChanged as error:
        raise ConfigError(f"{error.file} {error}") from error
