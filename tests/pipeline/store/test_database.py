"""The database returns what was recorded, also after damage to its file and on a full disk."""

import errno
from collections import Counter

import pytest

from flexroad.pipeline.store.database import NAME, PAGE, RunDatabase
from flexroad.pipeline.store.records import Failure, TileRecord

TILES = [f"{i}_{i}" for i in range(2 * PAGE + 7)]
"""Ids of tiles for more than two pages."""


def entry(tile: str) -> TileRecord:
    failed = int(tile.split("_")[0]) % 3 == 0
    failures = (Failure(tile, "fit", "TaskError", 'with "quotes", commas', "a.tif"),) if failed else ()
    rows = ({"tile_id": tile, "l2_road_m": 0.1 + 0.2, "triangles": 7, "nearest_road_m": None},)
    sources = [["dsm", [["dsm.tif", 3, 1700000000000000001]], [], None]]
    marker = ("failed.json" if failed else "item.json", 12, 1700000000000000002)
    state = "failed" if failed else "done"
    return TileRecord(
        tile, state, "f" * 32, rows, failures, sources, {"a.glb": 5}, "2026-01-01", 0.25, marker
    )


@pytest.fixture
def full(tmp_path):
    """A database with records of all tiles in reverse order, except the last tile, which is pending."""
    with RunDatabase.open(tmp_path / NAME) as database:
        database.set_states((tile, "pending") for tile in TILES)
        for tile in reversed(TILES[:-1]):
            database.record(entry(tile))
    return tmp_path / NAME


def test_recorded_tiles_are_read_in_catalog_order(full):
    records = {tile: entry(tile) for tile in TILES[:-1]}
    with RunDatabase.open_readonly(full) as database:
        assert {tile: database.get(tile) for tile in TILES} == records | {TILES[-1]: None}
        entries = list(database.entries())
        assert [tile for tile, _, _ in entries] == TILES
        assert [record for _, _, record in entries] == [*records.values(), None]
        assert list(database.rows()) == [row for record in records.values() for row in record.rows]
        assert list(database.failures()) == [
            failure for record in records.values() for failure in record.failures
        ]
        states = Counter(record.state for record in records.values())
        assert database.counts() == {**states, "pending": 1}


def test_tables_contain_only_current_tiles(full):
    with RunDatabase.open(full) as database:
        vanished = database.set_states([(TILES[5], "pending"), (TILES[3], "failed"), (TILES[4], "cached")])
        assert vanished == len(TILES) - 1 - 3
        assert [row["tile_id"] for row in database.rows()] == [TILES[3], TILES[4]]
        assert [failure.tile_id for failure in database.failures()] == [TILES[3]]
        assert (database.state(TILES[4]), database.state(TILES[0])) == ("cached", None)
        database.record(entry(TILES[5]))
        assert [row["tile_id"] for row in database.rows()] == [TILES[5], TILES[3], TILES[4]]
        assert database.get(TILES[0]) is None


@pytest.mark.parametrize(
    "damage",
    [
        lambda data: b"",
        lambda data: b"no database",
        lambda data: data[: len(data) // 2],
        lambda data: data[:8192] + b"\xff" * 4096 + data[12288:],
        lambda data: data[:60] + b"\0\0\0\x63" + data[64:],
    ],
    ids=["empty", "of another kind", "cut off", "overwritten", "of another version"],
)
def test_open_damaged_database_starts_empty(damage, full):
    full.write_bytes(damage(full.read_bytes()))
    with RunDatabase.open(full) as database:
        assert not database.counts()
        assert database.get(TILES[0]) is None
        database.set_states([(TILES[0], "pending")])
        database.record(entry(TILES[0]))
    with RunDatabase.open_readonly(full) as database:
        assert database.get(TILES[0]) == entry(TILES[0])


def test_read_while_writing_returns_new_records(full):
    with RunDatabase.open(full) as writer, RunDatabase.open_readonly(full) as reader:
        rows = reader.rows()
        next(rows)
        writer.set_states((tile, "pending") for tile in TILES)
        writer.record(entry(TILES[-1]))
        writer.flush()
        assert reader.get(TILES[-1]) == entry(TILES[-1])
        assert reader.counts() == {"pending": len(TILES) - 1, "done": 1}


def test_open_readonly_missing_database_creates_no_file(tmp_path):
    with RunDatabase.open_readonly(tmp_path / NAME) as database:
        assert not database.counts()
    assert not list(tmp_path.iterdir())


def test_records_wait_while_disk_is_full(tmp_path):
    with RunDatabase.open(tmp_path / NAME) as database:
        database.set_states((tile, "pending") for tile in TILES)
        database._connection.execute("PRAGMA max_page_count = 1")
        for tile in TILES:
            database.record(entry(tile))
        with pytest.raises(OSError, match=f"No space left on device.*{NAME}") as caught:
            database.flush()
        assert caught.value.errno == errno.ENOSPC
        assert database.get(TILES[0]) == entry(TILES[0])
        database._connection.execute("PRAGMA max_page_count = 100000")
    with RunDatabase.open_readonly(tmp_path / NAME) as database:
        assert [record for _, _, record in database.entries()] == [entry(tile) for tile in TILES]
