"""The database returns what was recorded, also after damage to its file and on a full disk."""

import contextlib
import errno
import json
import os
import sqlite3
from collections import Counter
from dataclasses import replace

import pytest

from flexroad.pipeline.store.database import NAME, PAGE, Listed, RunDatabase, digest
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
        assert database.listed(TILES) == Listed(Counter({**states, "pending": 1}), len(records))
        assert database.listed(TILES, "2026-01-01").finished == len(records)
        assert database.listed(TILES, "2026-01-02").finished == 0


def test_tables_contain_only_current_tiles(full):
    with RunDatabase.open(full) as database:
        vanished = database.set_states([(TILES[5], "pending"), (TILES[3], "failed"), (TILES[4], "cached")])
        assert vanished == len(TILES) - 1 - 3
        assert [row["tile_id"] for row in database.rows()] == [TILES[3], TILES[4]]
        assert [failure.tile_id for failure in database.failures()] == [TILES[3]]
        assert list(database.states()) == ["pending", "failed", "cached"]
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
        assert database.listed([]) == Listed()
        assert database.get(TILES[0]) is None
        database.set_states([(TILES[0], "pending")])
        database.record(entry(TILES[0]))
    with RunDatabase.open_readonly(full) as database:
        assert database.get(TILES[0]) == entry(TILES[0])


def change(path, *statements):
    """Change a database without changing its checksums."""
    with contextlib.closing(sqlite3.connect(path)) as connection, connection:
        for statement in statements:
            connection.execute(statement)


@pytest.mark.parametrize(
    "damage",
    [
        "UPDATE entry SET record = replace(record, '0.25', '8.25') WHERE tile = '4_4'",
        "UPDATE entry SET record = substr(record, 2) WHERE tile = '4_4'",
        "UPDATE entry SET record = CAST(record AS BLOB) WHERE tile = '4_4'",
        "UPDATE entry SET record = CAST(x'7bff7d' AS TEXT) WHERE tile = '4_4'",
        "UPDATE entry SET finished = 7 WHERE tile = '4_4'",
        "UPDATE entry SET checksum = NULL WHERE tile = '4_4'",
        "UPDATE entry SET tile = '5-5' WHERE tile = '4_4'",
        "DELETE FROM entry WHERE tile = '4_4'",
    ],
)
def test_damaged_entry_is_recovered_from_marker(damage, full):
    change(full, damage)
    asked = []

    def recover(tile):
        asked.append(tile)
        return entry(tile)

    for opened in (RunDatabase.open_readonly, RunDatabase.open):
        with opened(full, recover) as database:
            assert (database.get("4_4"), database.get("7_7")) == (None, entry("7_7"))
            assert database.lookup("4_4") == entry("4_4")
            assert database.listed(TILES) is not None
            assert list(database.rows()) == [row for tile in TILES[:-1] for row in entry(tile).rows]
            assert [record for _, _, record in database.entries()] == [*map(entry, TILES[:-1]), None]
    assert set(asked) <= {"4_4"}


def test_entry_of_earlier_write_is_not_taken(full):
    """A page that was written once more, but is there as before: its rows have valid checksums."""
    with RunDatabase.open(full) as database:
        database.record(replace(entry("4_4"), seconds=9.0))
    with contextlib.closing(sqlite3.connect(full)) as connection:
        (new,) = connection.execute("SELECT record FROM entry WHERE tile = '4_4'").fetchall()
    old = json.dumps(json.loads(new[0]) | {"seconds": 0.25})
    checksum = digest("4_4", "2026-01-01", old).hex()
    change(full, f"UPDATE entry SET record = '{old.replace(chr(39), chr(39) * 2)}', checksum = x'{checksum}'"
           " WHERE tile = '4_4'")  # fmt: skip
    with RunDatabase.open_readonly(full, lambda tile: replace(entry(tile), seconds=9.0)) as database:
        assert database.get("4_4").seconds == 0.25
        assert {tile: record.seconds for tile, _, record in database.entries() if record}["4_4"] == 9.0


@pytest.mark.parametrize(
    "damage",
    [
        "UPDATE asked SET standing = 'done' WHERE tile = '3_3'",
        "UPDATE asked SET standing = CAST(x'ff' AS TEXT) WHERE tile = '3_3'",
        "UPDATE asked SET finished = '' WHERE tile = '3_3'",
        "UPDATE asked SET roadless = 1 WHERE tile = '3_3'",
        "UPDATE asked SET position = 5000 WHERE tile = '3_3'",
        "UPDATE asked SET checksum = x'00' WHERE tile = '3_3'",
        "DELETE FROM asked WHERE tile = '3_3'",
        "DELETE FROM asked WHERE position > 3",
        "DELETE FROM asked",
        "DELETE FROM total",
        "UPDATE total SET checksum = zeroblob(16)",
        "UPDATE total SET checksum = 7",
    ],
)
def test_damaged_list_is_noticed_and_replaced(damage, full):
    change(full, damage)
    with RunDatabase.open_readonly(full) as database:
        assert database.listed(TILES) is None
    with RunDatabase.open(full) as database:
        # A record written meanwhile does not hide the damage.
        database.record(entry("3_3"))
        assert database.listed(TILES) is None
        assert database.set_states((tile, "pending") for tile in TILES) == 0
        assert database.listed(TILES).counts == {"pending": len(TILES)}


def test_list_of_earlier_write_is_noticed(full):
    with contextlib.closing(sqlite3.connect(full)) as connection:
        (old,) = connection.execute("SELECT * FROM asked WHERE tile = '4_4'").fetchall()
    with RunDatabase.open(full) as database:
        database.record(replace(entry("4_4"), state="failed"))
    with RunDatabase.open_readonly(full) as database:
        assert database.listed(TILES) is not None
        assert list(database.states())[4] == "failed"
    with contextlib.closing(sqlite3.connect(full)) as connection, connection:
        connection.execute("INSERT OR REPLACE INTO asked VALUES (?, ?, ?, ?, ?, ?, ?, ?)", old)
    with RunDatabase.open_readonly(full) as database:
        assert database.listed(TILES) is None


@pytest.mark.parametrize("size", [0, 100, 5000, 60_000])
def test_database_damaged_while_open_is_made_anew(size, full):
    with RunDatabase.open(full) as database:
        database._connection.execute("PRAGMA cache_size = 1")
        with full.open("r+b") as file:
            file.truncate(size)
            file.seek(0)
            file.write(b"\xff" * min(size, 8192))
        database.record(replace(entry("4_4"), seconds=9.0))
        database.flush()
        assert database.listed(TILES) is None
        assert database.get("4_4").seconds == 9.0
        database.set_states((tile, "done") for tile in TILES)
        assert database.listed(TILES).counts == {"done": len(TILES)}
    with RunDatabase.open_readonly(full) as database:
        assert database.listed(TILES).counts == {"done": len(TILES)}


def test_damaged_database_on_a_full_disk_says_so_until_there_is_space(full, monkeypatch):
    def no_space(path, *_):
        raise OSError(errno.ENOSPC, "No space left on device", str(path))

    with RunDatabase.open(full) as database:
        database._connection.execute("PRAGMA cache_size = 1")
        full.write_bytes(b"\xff" * 8192)
        monkeypatch.setattr("flexroad.pipeline.store.database.create", no_space)
        for number in ("1_1", "4_4"):
            database.record(entry(number))
            with pytest.raises(OSError, match="No space left on device"):
                database.flush()
        database._pending.clear()
        with pytest.raises(OSError, match=f"it is damaged and could not be made anew: .*{NAME}"):
            list(database.states())
        monkeypatch.undo()
        database.record(entry("4_4"))
    with RunDatabase.open_readonly(full) as database:
        assert database.get("4_4") == entry("4_4")


@pytest.mark.parametrize("mask", [0o002, 0o022, 0o077])
def test_database_has_the_rights_that_the_umask_gives(tmp_path, mask):
    before = os.umask(mask)
    try:
        with RunDatabase.open(tmp_path / NAME) as database:
            database.set_states([("a", "pending")])
    finally:
        os.umask(before)
    assert (tmp_path / NAME).stat().st_mode & 0o777 == 0o666 & ~mask


def test_file_that_calls_itself_read_only_is_replaced(full):
    data = bytearray(full.read_bytes())
    data[18] = 9
    full.write_bytes(data)
    with RunDatabase.open(full) as database:
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
        assert reader.listed(TILES).counts == {"pending": len(TILES) - 1, "done": 1}


def test_open_readonly_missing_database_creates_no_file(tmp_path):
    with RunDatabase.open_readonly(tmp_path / NAME) as database:
        assert database.listed([]) == Listed()
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
