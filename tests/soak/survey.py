"""A survey of small tiles whose files, catalog, options and program change from night to night.

A tile has a side of 120 m, so that a file concerns its tile and the neighbours, but only 24 x 24 cells.
"""

import json
import os
import shutil
from dataclasses import replace
from datetime import UTC, datetime
from functools import cached_property
from pathlib import Path
from random import Random

import numpy as np
import shapely

from flexroad.catalog import Catalog, Grid, Tile
from flexroad.catalog.scan import vectors
from flexroad.tools.synthetic import prepared

COLUMNS, ROWS, CELLS, CELL_M = 10, 2, 24, 5.0
SIZE_M = CELLS * CELL_M
WEST, SOUTH, CRS = 500_000.0, 5_600_000.0, "EPSG:25832"
GRIDS = {
    f"{column}{row}": Grid(CRS, WEST + column * SIZE_M, SOUTH + (row + 1) * SIZE_M, CELL_M, CELLS, CELLS)
    for column in range(COLUMNS)
    for row in range(ROWS)
}
ANCHOR = "00"
"""The tile in the south-west, which all catalogs have: meshes are relative to its corner."""
REACH_M = 100.0
"""A tile is concerned by files up to this far from it: so far sees the ground along its border."""
ROADS = {"west.geojson": (0, 6), "east.geojson": (4, COLUMNS)}
"""Files of roads, each with the columns of tiles that it has roads of."""
CONFIG = {
    "extends": "production",
    "cluster": {"flush": False},
    "fit": {"spacing_m": 20},
    "sample": {"road_m": 5},
}
CHOICES = {
    "export.formats": ('["ply"]', '["glb", "npz"]', '["cog", "ply"]'),
    "segment": ("mask", "vector"),
    "load.halo_m": ("20", "40"),
    "load.min_valid": ("0.25", "0.9"),
    "ecsrc.shoulder_m": ("5", "10"),
    "fit.bending_m3": ("30", "100"),
    "sample.terrain_m": ("20", "30"),
}
"""The options that change, and their values."""
SPECIAL = {"a hole": 0.0, "empty": 0.0, "half a cell away": CELL_M / 2, "far away": 20 * SIZE_M}
"""What is the matter with a raster of heights, and how far it is moved eastwards (m)."""
MOST_CHANGED = 8
"""Number of changed files above which only restoring is possible."""

Change = tuple[str, set[str]]
"""What has changed, and the tiles that it concerns."""


def ground(grid: Grid) -> dict[str, np.ndarray]:
    """Return the layers of a tile: waves with two directions of roads, and objects of 4 m beside these."""
    rows, columns = np.mgrid[: grid.height, : grid.width]
    x, y = grid.west - WEST + (columns + 0.5) * CELL_M, grid.north - SOUTH - (rows + 0.5) * CELL_M
    road = (x % 75 < 15) | (y % 90 < 15)
    dtm = 200 + 0.02 * x + 3 * np.sin(y / 60)
    above = np.where(np.sin(x / 9) * np.sin(y / 11) > 0.3, 4.0, 0.0)
    return {"dsm": dtm + np.where(road, 0.05 * np.sin(3 * x + 7 * y), above), "dtm": dtm, "road_mask": road}


def roads(first: int, last: int) -> bytes:
    """Return the areas of the roads of some columns of tiles as GeoJSON."""
    west, east, north = first * SIZE_M, last * SIZE_M, ROWS * SIZE_M
    boxes = [(x, 0, x + 15, north) for x in np.arange(0, COLUMNS * SIZE_M, 75) if west <= x < east]
    boxes += [(west, y, east, y + 15) for y in np.arange(0, north, 90)]
    areas = [shapely.box(WEST + a, SOUTH + b, WEST + c, SOUTH + d) for a, b, c, d in boxes]
    crs = {"type": "name", "properties": {"name": CRS}}
    features = [{"type": "Feature", "properties": {}, "geometry": shapely.geometry.mapping(a)} for a in areas]
    return json.dumps({"type": "FeatureCollection", "crs": crs, "features": features}).encode()


def damage(path: Path, random: Random) -> str:
    """Delete, cut off or overwrite a file; return which."""
    data, what = path.read_bytes(), random.choice(("deleted", "cut off", "overwritten"))
    at = random.randrange(len(data) or 1)
    if what == "deleted":
        path.unlink()
        return what
    path.write_bytes(data[:at] + (random.randbytes(20) + data[at + 20 :] if what == "overwritten" else b""))
    return f"{what} at byte {at}"


class Survey:
    """The sources, the catalog, the options and the version of the program of each night."""

    def __init__(self, folder: Path) -> None:
        self.folder, self._original = folder / "survey", folder / "original"
        date = datetime(2025, 1, 1, tzinfo=UTC)
        self._written = [
            prepared.write_tile(self._original, tile_id, grid, ground(grid), date=date, dataset="waves")
            for tile_id, grid in GRIDS.items()
        ]
        for name, columns in ROADS.items():
            (self._original / name).write_bytes(roads(*columns))
        shutil.copytree(self._original, self.folder)
        self.files = sorted(
            path.relative_to(self.folder).as_posix() for path in self.folder.rglob("*") if path.is_file()
        )
        self.program = 0
        """Version of the program."""
        self._options = {name: values[0] for name, values in CHOICES.items()}
        self._changed: set[str] = set()
        self._left_out: set[str] = set()
        """Tiles that the catalog leaves out; their neighbours list their files."""
        self._gone: set[str] = set()
        """Tiles that the catalog leaves out as if they had no files."""
        self._seconds = 1_800_000_000

    @property
    def catalog(self) -> Catalog:
        tiles = self._tiles(GRIDS.keys() - self._gone) if self._gone else self._all_tiles
        return Catalog(tuple(tile for tile in tiles if tile.id not in self._left_out))

    @cached_property
    def _all_tiles(self) -> tuple[Tile, ...]:
        return self._tiles(GRIDS.keys())

    def _tiles(self, ids: set[str]) -> tuple[Tile, ...]:
        """Return the tiles of the catalog of the original files: damage does not change it."""
        lines = [vectors.opened(self._original / name, None) for name in ROADS]
        own = [tile for tile in self._written if tile.id in ids]
        tiles, _ = vectors.with_roads(prepared.with_neighbours(own), lines, None)
        return tuple(replace(tile, root=str(self.folder)) for tile in tiles)

    @property
    def options(self) -> list[str]:
        """The words of the command line that set the options."""
        return [word for name, value in self._options.items() for word in ("--set", f"{name}={value}")]

    def change(self, random: Random) -> Change:
        """Make one change."""
        sources = [self.edit] * 5 + [self._damage] * 3 + [self._restore] * 4
        others = [self._leave_out, self._shrink, self._reconfigure, self._update]
        return random.choice([*sources, *others] if len(self._changed) < MOST_CHANGED else [self._restore])(
            random
        )

    def edit(self, random: Random, name: str = "") -> Change:
        """Write a file with other values, or give it only another time."""
        name = name or random.choice(self.files)
        path = self.folder / name
        if path.exists() and random.random() < 0.2:
            return self._stamped(name, "touched")
        if name in ROADS:
            first, last = sorted(random.sample(range(COLUMNS + 1), 2))
            path.write_bytes(roads(first, last))
            return self._stamped(name, f"has columns {first} to {last}")
        what = self._write_raster(path, random)
        return self._stamped(name, what)

    def _write_raster(self, path: Path, random: Random) -> str:
        grid, layer = GRIDS[path.stem], path.parent.name
        rows, columns = (slice(*sorted(random.sample(range(CELLS + 1), 2))) for _ in range(2))
        values, what = ground(grid)[layer], random.choice(("other values", "other values", *SPECIAL))
        if layer == "road_mask":
            values[rows, columns] ^= True
        elif what == "empty":
            values[:] = np.nan
        else:
            values[rows, columns] += np.nan if what == "a hole" else random.uniform(-2, 2)
        placed = replace(grid, west=grid.west + SPECIAL.get(what, 0.0))
        prepared.write_tile(self.folder, path.stem, placed, {layer: values}, dataset="waves")
        return what

    def _damage(self, random: Random) -> Change:
        name = random.choice(self.files)
        if not (self.folder / name).exists():
            return self._restore(random, name)
        return self._stamped(name, damage(self.folder / name, random))

    def _restore(self, random: Random, name: str = "") -> Change:
        """Put a file back as it was, with its former time."""
        name = name or random.choice(sorted(self._changed) or self.files)
        shutil.copy2(self._original / name, self.folder / name)
        self._changed.discard(name)
        return f"{name} restored", self.around(name)

    def _leave_out(self, random: Random) -> Change:
        """Take a tile out of the catalog, or put it back; its files stay."""
        return self._toggle(self._left_out, "left out", random)

    def _shrink(self, random: Random) -> Change:
        """Make the catalog without the files of a tile, or with them again."""
        return self._toggle(self._gone, "gone", random)

    def _toggle(self, tiles: set[str], what: str, random: Random) -> Change:
        tile = random.choice(sorted(GRIDS.keys() - {ANCHOR} if len(tiles) < 2 else tiles))
        tiles ^= {tile}
        return f"{tile} {what if tile in tiles else f'no longer {what}'}", self.around(tile)

    def _reconfigure(self, random: Random) -> Change:
        name = random.choice(sorted(CHOICES))
        self._options[name] = random.choice([v for v in CHOICES[name] if v != self._options[name]])
        return f"{name}={self._options[name]}", set(GRIDS)

    def _update(self, random: Random) -> Change:
        self.program = 1 - self.program
        return f"program {self.program}", set(GRIDS)

    def around(self, name: str) -> set[str]:
        """Return the tiles that a file, or the files of a tile, concern."""
        own = GRIDS.get(Path(name).stem)
        if own is None:
            return set(GRIDS) if self._options["segment"] == "vector" else set()
        near = shapely.box(*own.buffered(REACH_M).bounds)
        return {tile for tile, grid in GRIDS.items() if near.intersects(shapely.box(*grid.bounds))}

    def _stamped(self, name: str, what: str) -> Change:
        """Give a changed file a time of its own: within one tick of the clock two would have the same."""
        self._changed.add(name)
        self._seconds += 1
        if (self.folder / name).exists():
            os.utime(self.folder / name, (self._seconds, self._seconds))
        return f"{name} {what}", self.around(name)
