"""The database, and JSON files with a checksum: damage is noticed, and records wait on a full disk."""

import errno
import json
import os
import resource
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from flexroad.pipeline.store.database import NAME, RunDatabase
from flexroad.pipeline.store.records import CHECKSUM, Failure, TileRecord, dump_checked, load_checked

TILES = [f"{i}_{i}" for i in range(100)]
DONE = ("1_1", "2_2")
"""Tiles of the smallest file that has all kinds of lines."""


def entry(tile: str) -> TileRecord:
    failed = int(tile.split("_")[0]) % 3 == 0
    failures = (Failure(tile, "fit", "TaskError", 'with "quotes",\ttabs', "a.tif"),) if failed else ()
    rows = ({"tile_id": tile, "l2_road_m": 0.1 + 0.2, "triangles": 7, "nearest_road_m": None},)
    sources = [["dsm", [["dsm.tif", 3, 1700000000000000001]], [], None]]
    marker = ("failed.json" if failed else "item.json", 12, 1700000000000000002)
    state = "failed" if failed else "done"
    return TileRecord(
        tile, state, "f" * 32, rows, failures, sources, {"a.glb": 5}, "2026-01-01", 0.25, marker
    )


def lines(path) -> list:
    with RunDatabase(path) as database:
        return list(database.entries())


@pytest.fixture
def full(tmp_path):
    """A database with records of all tiles in reverse order, except the last tile, which is pending."""
    with RunDatabase(tmp_path / NAME, writable=True) as database:
        database.set_states((tile, "pending") for tile in TILES)
        for tile in reversed(TILES[:-1]):
            database.record(entry(tile))
    return tmp_path / NAME


@pytest.fixture
def small(tmp_path):
    """A database of a tile that was recorded twice, and one that was recorded once."""
    with RunDatabase(tmp_path / NAME, writable=True) as database:
        database.set_states((tile, "pending") for tile in DONE)
        for record in (replace(entry(DONE[0]), seconds=9.0), entry(DONE[1]), entry(DONE[0])):
            database.record(record)
            database.flush()
    return tmp_path / NAME


def test_recorded_tiles_are_read_in_catalog_order(full):
    records = {tile: entry(tile) for tile in TILES[:-1]}
    expected = [(tile, record.state, record) for tile, record in records.items()]
    assert lines(full) == [*expected, (TILES[-1], "pending", None)]
    with RunDatabase(full) as database:
        assert {tile: database.get(tile) for tile in TILES} == records | {TILES[-1]: None}
        assert database.lists(TILES)
        assert not database.lists(TILES[1:])
        assert not database.lists(reversed(TILES))


def test_list_has_only_current_tiles(full):
    with RunDatabase(full, writable=True) as database:
        current = [(TILES[5], "pending"), (TILES[3], "failed"), (TILES[4], "cached"), ("new", "pending")]
        assert database.set_states(current) == len(TILES) - 1 - 3
        assert [line[:2] for line in database.entries()] == current
        database.record(entry(TILES[5]))
        assert next(database.entries()) == (TILES[5], "done", entry(TILES[5]))
        assert database.get(TILES[0]) is None
        assert database.get("new") is None


def test_any_changed_byte_makes_the_database_empty(small):
    whole = small.read_bytes()
    assert lines(small) == [(tile, "done", entry(tile)) for tile in DONE]
    for position in range(len(whole)):
        for bits in (1 << position % 8, 0xFF):
            damaged = bytearray(whole)
            damaged[position] ^= bits
            small.write_bytes(damaged)
            assert lines(small) == [], position


def test_any_missing_or_additional_part_makes_the_database_empty(small):
    whole = small.read_bytes()
    header, *rows = whole.splitlines(keepends=True)
    assert len(rows) == 5
    damaged = [whole[:end] for end in range(len(whole))]
    damaged += [whole + b"\n", whole + rows[-1], header, b"no database"]
    damaged += [header + b"".join(rows[:i] + rows[i + 1 :]) for i in range(len(rows))]
    damaged += [header + b"".join([*rows[:i], rows[i + 1], rows[i], *rows[i + 2 :]]) for i in range(4)]
    for data in damaged:
        small.write_bytes(data)
        assert lines(small) == []
    with RunDatabase(small, writable=True) as database:
        database.set_states([(TILES[0], "pending")])
        database.record(entry(TILES[0]))
    assert lines(small) == [(TILES[0], "failed", entry(TILES[0]))]


def test_state_of_the_file_before_a_write_is_valid(full):
    """A process that is killed while it adds a line leaves the former file, or one that counts as empty."""
    before = lines(full)
    with RunDatabase(full, writable=True) as database:
        first = full.read_bytes()
        database.record(entry(TILES[-1]))
        database.flush()
        second = full.read_bytes()
        assert second[: len(first)].splitlines()[1:] == first.splitlines()[1:]
        for data, expected in ((first, before), (first + second[len(first) :], []), (second[:-5], [])):
            full.write_bytes(data)
            assert lines(full) == expected


def test_database_damaged_while_open_gives_no_damaged_record(full):
    with RunDatabase(full, writable=True) as database:
        database.set_states((tile, "done") for tile in TILES)
        full.write_bytes(full.read_bytes().replace(b"0.25", b"8.25"))
        assert [database.get(tile) for tile in TILES] == [None] * len(TILES)
        database.record(entry("4_4"))
        assert database.get("4_4") == entry("4_4")
        with pytest.raises(OSError, match=f"the list of tiles is damaged.*{NAME}"):
            list(database.entries())
        assert not database.load()
        database.record(entry("5_5"))
        database.set_states((tile, "done") for tile in TILES)
        assert database.lists(TILES)
    assert {tile: record for tile, _, record in lines(full) if record} == {"5_5": entry("5_5")}


def test_database_deleted_while_open_is_noticed(full):
    with RunDatabase(full, writable=True) as database:
        full.unlink()
        database.record(entry("4_4"))
        database.flush()
        assert not database.load()
        assert not database.lists(TILES)


@pytest.mark.parametrize("mask", [0o002, 0o022, 0o077])
def test_database_has_the_rights_that_the_umask_gives(tmp_path, mask):
    before = os.umask(mask)
    try:
        with RunDatabase(tmp_path / NAME, writable=True) as database:
            database.set_states([("a", "pending")])
    finally:
        os.umask(before)
    assert (tmp_path / NAME).stat().st_mode & 0o777 == 0o666 & ~mask


def test_reader_has_one_state_of_a_file_that_is_written(full):
    with RunDatabase(full, writable=True) as writer, RunDatabase(full) as reader:
        before = lines(full)
        writer.record(entry(TILES[-1]))
        writer.flush()
        assert list(reader.entries()) == before
        assert lines(full)[-1] == (TILES[-1], "failed", entry(TILES[-1]))
        writer.set_states((tile, "pending") for tile in TILES)
        assert list(reader.entries()) == before
        assert {state for _, state, _ in lines(full)} == {"pending"}


def test_open_readonly_missing_database_creates_no_file_and_opens_no_pipe(tmp_path):
    assert lines(tmp_path / NAME) == []
    assert not list(tmp_path.iterdir())
    os.mkfifo(tmp_path / NAME)
    assert lines(tmp_path / NAME) == []


def test_database_is_a_text_that_programs_can_read(small):
    title, *rows = small.read_text().splitlines()
    assert title.startswith("flexroad database ")
    fields = [[json.loads(text) for text in row.split("\t")[1:]] for row in rows]
    assert [(tile, state) for tile, state, _ in fields[2:]] == [(tile, "done") for tile in (*DONE, DONE[0])]


def test_records_wait_while_disk_is_full(tmp_path):
    with RunDatabase(tmp_path / NAME, writable=True) as database:
        database.set_states((tile, "pending") for tile in TILES)
        soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
        resource.setrlimit(resource.RLIMIT_FSIZE, ((tmp_path / NAME).stat().st_size + 1000, hard))
        try:
            for tile in TILES:
                database.record(entry(tile))
            with pytest.raises(OSError, match=f"File too large.*{NAME}") as caught:
                database.flush()
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        assert caught.value.errno == errno.EFBIG
        assert database.get(TILES[0]) == entry(TILES[0])
    assert [record for _, _, record in lines(tmp_path / NAME)] == [entry(tile) for tile in TILES]


values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | st.text(),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(), inner, max_size=4),
    max_leaves=12,
)
CONTENT = {"id": "a", "rows": [{"road_l2": 0.0281, "tile": "ä"}], "size": 17}


@given(content=st.dictionaries(st.text(), values, max_size=5).filter(lambda c: CHECKSUM not in c))
def test_loads_what_was_dumped(content):
    assert load_checked(dump_checked(content)) == content


def test_any_flipped_bit_is_noticed_or_changes_no_value():
    data = dump_checked(CONTENT)
    noticed = 0
    for at in range(len(data)):
        for bit in range(8):
            copy = bytearray(data)
            copy[at] ^= 1 << bit
            try:
                assert load_checked(bytes(copy)) == CONTENT
            except ValueError:
                noticed += 1
    assert noticed > 7 * len(data)


def test_format_and_order_of_keys_do_not_matter():
    content = json.loads(dump_checked(CONTENT))
    again = json.dumps(dict(reversed(content.items())), separators=(",", ":"), ensure_ascii=False)
    assert load_checked(again.encode()) == CONTENT


@pytest.mark.parametrize(
    "data", [b"", b"[]", b"{}", b"1", b"null", json.dumps(CONTENT).encode(), b"[" * 100_000, b"\xff\xfe{"]
)
def test_other_files_raise_value_error(data):
    with pytest.raises(ValueError, match="."):
        load_checked(data)


def test_numbers_that_json_lacks_raise_error():
    with pytest.raises(ValueError, match="JSON"):
        dump_checked({"height": float("inf")})
