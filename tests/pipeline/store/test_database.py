"""The ledger answers as a plain dictionary would, whatever becomes of its file."""

import errno
from collections import Counter

import pytest

from flexroad.pipeline.store.database import NAME, PAGE, Ledger
from flexroad.pipeline.store.records import Entry, Failure

TILES = [f"{i}_{i}" for i in range(2 * PAGE + 7)]
"""More than two pages."""


def entry(tile: str) -> Entry:
    failed = int(tile.split("_")[0]) % 3 == 0
    failures = (Failure(tile, "fit", "TaskError", 'with "quotes", commas', "a.tif"),) if failed else ()
    rows = ({"tile_id": tile, "l2_road_m": 0.1 + 0.2, "triangles": 7, "nearest_road_m": None},)
    sources = [["dsm", [["dsm.tif", 3, 1700000000000000001]], [], None]]
    marker = ("failed.json" if failed else "item.json", 12, 1700000000000000002)
    state = "failed" if failed else "done"
    return Entry(tile, state, "f" * 32, rows, failures, sources, {"a.glb": 5}, "2026-01-01", 0.25, marker)


@pytest.fixture
def full(tmp_path):
    """A ledger of every tile but the last, which is pending, written backwards."""
    with Ledger.open(tmp_path / NAME) as ledger:
        ledger.ask((tile, "pending") for tile in TILES)
        for tile in reversed(TILES[:-1]):
            ledger.record(entry(tile))
    return tmp_path / NAME


def test_what_is_recorded_comes_back_in_the_catalogs_order(full):
    known = {tile: entry(tile) for tile in TILES[:-1]}
    with Ledger.peek(full) as ledger:
        assert {tile: ledger.get(tile) for tile in TILES} == known | {TILES[-1]: None}
        found = list(ledger.entries())
        assert [tile for tile, _, _ in found] == TILES
        assert [which for _, _, which in found] == [*known.values(), None]
        assert list(ledger.rows()) == [row for one in known.values() for row in one.rows]
        assert list(ledger.failures()) == [fault for one in known.values() for fault in one.failures]
        states = Counter(one.state for one in known.values())
        assert ledger.counts() == {**states, "pending": 1}


def test_only_what_stands_is_in_the_tables(full):
    with Ledger.open(full) as ledger:
        vanished = ledger.ask([(TILES[5], "pending"), (TILES[3], "failed"), (TILES[4], "cached")])
        assert vanished == len(TILES) - 1 - 3
        assert [row["tile_id"] for row in ledger.rows()] == [TILES[3], TILES[4]]
        assert [failure.tile_id for failure in ledger.failures()] == [TILES[3]]
        assert (ledger.standing(TILES[4]), ledger.standing(TILES[0])) == ("cached", None)
        ledger.record(entry(TILES[5]))
        assert [row["tile_id"] for row in ledger.rows()] == [TILES[5], TILES[3], TILES[4]]
        assert ledger.get(TILES[0]) is None


@pytest.mark.parametrize(
    "spoil",
    [
        lambda data: b"",
        lambda data: b"no ledger",
        lambda data: data[: len(data) // 2],
        lambda data: data[:8192] + b"\xff" * 4096 + data[12288:],
        lambda data: data[:60] + b"\0\0\0\x63" + data[64:],
    ],
    ids=["empty", "of another kind", "cut off", "overwritten", "of another version"],
)
def test_a_damaged_ledger_begins_empty(spoil, full):
    full.write_bytes(spoil(full.read_bytes()))
    with Ledger.open(full) as ledger:
        assert not ledger.counts()
        assert ledger.get(TILES[0]) is None
        ledger.ask([(TILES[0], "pending")])
        ledger.record(entry(TILES[0]))
    with Ledger.peek(full) as ledger:
        assert ledger.get(TILES[0]) == entry(TILES[0])


def test_one_reads_while_another_writes(full):
    with Ledger.open(full) as writer, Ledger.peek(full) as reader:
        rows = reader.rows()
        next(rows)
        writer.ask((tile, "pending") for tile in TILES)
        writer.record(entry(TILES[-1]))
        writer.flush()
        assert reader.get(TILES[-1]) == entry(TILES[-1])
        assert reader.counts() == {"pending": len(TILES) - 1, "done": 1}


def test_nobody_makes_a_ledger_by_looking(tmp_path):
    with Ledger.peek(tmp_path / NAME) as ledger:
        assert not ledger.counts()
    assert not list(tmp_path.iterdir())


def test_what_a_full_disk_does_not_take_waits(tmp_path):
    with Ledger.open(tmp_path / NAME) as ledger:
        ledger.ask((tile, "pending") for tile in TILES)
        ledger._connection.execute("PRAGMA max_page_count = 1")
        for tile in TILES:
            ledger.record(entry(tile))
        with pytest.raises(OSError, match=f"No space left on device.*{NAME}") as caught:
            ledger.flush()
        assert caught.value.errno == errno.ENOSPC
        assert ledger.get(TILES[0]) == entry(TILES[0])
        ledger._connection.execute("PRAGMA max_page_count = 100000")
    with Ledger.peek(tmp_path / NAME) as ledger:
        assert [one for _, _, one in ledger.entries()] == [entry(tile) for tile in TILES]
