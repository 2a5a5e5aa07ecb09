"""The memory of an export does not grow with the number of its tiles."""

import gc
import os
import signal
import tracemalloc
from dataclasses import replace

import pytest

from flexroad.pipeline.execute import SerialExecutor
from flexroad.pipeline.run.finished import file_states
from flexroad.tools.export.driver import export
from flexroad.tools.export.source import Source, select

from .conftest import OPTIONS

pytestmark = [pytest.mark.slow, pytest.mark.soak("exports")]

CHILD_S = 600
"""Longest time of a process that measures (s)."""
FIRST, FEW, MANY = 3, 60, 240
GROWTH_BYTES = 1_200_000
"""Bound of the growth: the meshes of the 180 tiles more are 2 MB. A buffer of 1 MB is full only with many."""
ENTRY_BYTES = {"3dtiles": 8000}
"""What a format keeps per tile besides: the entry of the tile in its tilesets."""
SPREAD_M = {"3dtiles": 1000.0}
"""Distance of the tiles: a coarse mesh is made of all tiles of a square kilometre at once."""


def many(city, number: int, spread_m: float = 0.0) -> Source:
    """The first tile of a run under many ids, all with its results."""
    whole = select(city.path, city.done[:1])
    (tile,), (snapshot,), state = whole.tiles, whole.snapshots, file_states(whole.run)
    grids = (replace(tile.grid, west=tile.grid.west + k * spread_m) for k in range(number))
    tiles = tuple(replace(tile, id=f"{k:04}", grid=grid) for k, grid in enumerate(grids))
    snapshots = tuple(replace(snapshot, files=state(one)) for one in tiles)
    return replace(whole, tiles=tiles, snapshots=snapshots)


def peak_bytes(source: Source, name: str, out) -> int:
    gc.collect()
    # Without the objects of the program, cycles of a tile are collected as soon as there are some.
    gc.freeze()
    tracemalloc.start()
    try:
        assert export(source, out, [name], OPTIONS, SerialExecutor())["tiles"] == len(source.tiles)
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
        gc.unfreeze()


def growth_bytes(city, name, folder) -> int:
    """The growth from few tiles to many, in a process of its own.

    In the process of the tests the threads of a cluster may take memory at the same time.
    """
    reader, writer = os.pipe()
    if child := os.fork():
        os.close(writer)
        with os.fdopen(reader) as answer:
            said = answer.read()
        os.waitpid(child, 0)
        return int(said)
    try:
        signal.alarm(CHILD_S)
        first, few, lots = (many(city, number, SPREAD_M.get(name, 0.0)) for number in (FIRST, FEW, MANY))
        # Code is loaded and compiled before anything is measured.
        peak_bytes(first, name, folder / "first")
        growth = peak_bytes(lots, name, folder / "many") - peak_bytes(few, name, folder / "few")
        os.write(writer, str(growth).encode())
    finally:
        os._exit(0)


@pytest.mark.parametrize("name", ["3dtiles", "landxml", "cityjson", "obj", "step"])
def test_memory_does_not_grow_with_the_tiles(made_city, tmp_path, name):
    bound = GROWTH_BYTES + (MANY - FEW) * ENTRY_BYTES.get(name, 0)
    # Something else in Python may take memory once; what a format keeps of each tile is there each time.
    grown = [growth_bytes(made_city, name, tmp_path / "a")]
    if grown[0] >= bound:
        grown.append(growth_bytes(made_city, name, tmp_path / "b"))
    assert min(grown) < bound, grown


def test_growth_would_be_noticed(made_city):
    """The meshes alone exceed the bound."""
    tracemalloc.start()
    kept = [tile.mesh for tile in many(made_city, MANY - FEW).finished()]
    size = tracemalloc.get_traced_memory()[0]
    tracemalloc.stop()
    assert len(kept) == MANY - FEW
    assert size > 1.5 * GROWTH_BYTES
