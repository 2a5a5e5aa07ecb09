"""The database answers as a plain dictionary would, whatever becomes of its file."""

import errno
from collections import Counter

import pytest

from flexroad.pipeline.store.database import NAME, PAGE, RunDatabase
from flexroad.pipeline.store.records import Failure, TileRecord

TILES = [f"{i}_{i}" for i in range(2 * PAGE + 7)]
"""More than two pages."""


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
    """A database of every tile but the last, which is pending, written backwards."""
    with RunDatabase.open(tmp_path / NAME) as database:
        database.ask((tile, "pending") for tile in TILES)
        for tile in reversed(TILES[:-1]):
            database.record(entry(tile))
    return tmp_path / NAME


def test_what_is_recorded_comes_back_in_the_catalogs_order(full):
    known = {tile: entry(tile) for tile in TILES[:-1]}
    with RunDatabase.peek(full) as database:
        assert {tile: database.get(tile) for tile in TILES} == known | {TILES[-1]: None}
        found = list(database.entries())
        assert [tile for tile, _, _ in found] == TILES
        assert [which for _, _, which in found] == [*known.values(), None]
        assert list(database.rows()) == [row for one in known.values() for row in one.rows]
        assert list(database.failures()) == [fault for one in known.values() for fault in one.failures]
        states = Counter(one.state for one in known.values())
        assert database.counts() == {**states, "pending": 1}


def test_only_what_stands_is_in_the_tables(full):
    with RunDatabase.open(full) as database:
        vanished = database.ask([(TILES[5], "pending"), (TILES[3], "failed"), (TILES[4], "cached")])
        assert vanished == len(TILES) - 1 - 3
        assert [row["tile_id"] for row in database.rows()] == [TILES[3], TILES[4]]
        assert [failure.tile_id for failure in database.failures()] == [TILES[3]]
        assert (database.standing(TILES[4]), database.standing(TILES[0])) == ("cached", None)
        database.record(entry(TILES[5]))
        assert [row["tile_id"] for row in database.rows()] == [TILES[5], TILES[3], TILES[4]]
        assert database.get(TILES[0]) is None


@pytest.mark.parametrize(
    "spoil",
    [
        lambda data: b"",
        lambda data: b"no database",
        lambda data: data[: len(data) // 2],
        lambda data: data[:8192] + b"\xff" * 4096 + data[12288:],
        lambda data: data[:60] + b"\0\0\0\x63" + data[64:],
    ],
    ids=["empty", "of another kind", "cut off", "overwritten", "of another version"],
)
def test_a_damaged_ledger_begins_empty(spoil, full):
    full.write_bytes(spoil(full.read_bytes()))
    with RunDatabase.open(full) as database:
        assert not database.counts()
        assert database.get(TILES[0]) is None
        database.ask([(TILES[0], "pending")])
        database.record(entry(TILES[0]))
    with RunDatabase.peek(full) as database:
        assert database.get(TILES[0]) == entry(TILES[0])


def test_one_reads_while_another_writes(full):
    with RunDatabase.open(full) as writer, RunDatabase.peek(full) as reader:
        rows = reader.rows()
        next(rows)
        writer.ask((tile, "pending") for tile in TILES)
        writer.record(entry(TILES[-1]))
        writer.flush()
        assert reader.get(TILES[-1]) == entry(TILES[-1])
        assert reader.counts() == {"pending": len(TILES) - 1, "done": 1}


def test_nobody_makes_a_ledger_by_looking(tmp_path):
    with RunDatabase.peek(tmp_path / NAME) as database:
        assert not database.counts()
    assert not list(tmp_path.iterdir())


def test_what_a_full_disk_does_not_take_waits(tmp_path):
    with RunDatabase.open(tmp_path / NAME) as database:
        database.ask((tile, "pending") for tile in TILES)
        database._connection.execute("PRAGMA max_page_count = 1")
        for tile in TILES:
            database.record(entry(tile))
        with pytest.raises(OSError, match=f"No space left on device.*{NAME}") as caught:
            database.flush()
        assert caught.value.errno == errno.ENOSPC
        assert database.get(TILES[0]) == entry(TILES[0])
        database._connection.execute("PRAGMA max_page_count = 100000")
    with RunDatabase.peek(tmp_path / NAME) as database:
        assert [one for _, _, one in database.entries()] == [entry(tile) for tile in TILES]
