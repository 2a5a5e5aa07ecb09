"""Ids of tiles and the file names made from them."""

import re

import pytest

from flexroad.catalog import CatalogError
from flexroad.catalog.ids import MAX_BYTES, check, problem, safe_name
from flexroad.catalog.text import printable, shown
from flexroad.pipeline.worker.exports import KINDS


@pytest.mark.parametrize(
    ("tile_id", "message"),
    [
        ("", "'' is empty"),
        (" ", "' ' is empty"),
        (17, "17 is not a text"),
        (None, "None is not a text"),
        ("a\0", r"'a\\x00' has characters that cannot be printed"),
        ("a\n", "cannot be printed"),
        ("a\ud800", "cannot be printed"),
        ("x" * 101, "has 101 bytes, more than 100"),
        ("ü" * 51, "has 102 bytes, more than 100"),
    ],
)
def test_unusable_id_is_named(tile_id, message):
    assert re.search(message, problem(tile_id))
    assert problem(tile_id).isprintable()


def test_unusable_id_is_an_error():
    with pytest.raises(
        CatalogError, match=r"tile id 'a\\n' has characters .*; rename the tile in its source"
    ):
        check(["a", "a\n"])


@pytest.mark.parametrize(
    "tile_id", ["295500_5629250", "a b", "ü" * 50, "x" * 100, "../a", ".", "a/b", "道路"]
)
def test_usable_ids(tile_id):
    assert not problem(tile_id)
    check([tile_id, "b"])


def test_equal_ids_are_named_with_a_remedy():
    with pytest.raises(CatalogError, match="but a, c occur more than once; rename those tiles"):
        check(["a", "b", "c", "a", "c"])
    with pytest.raises(CatalogError, match=r"tile ids 'M\\xfcnster', 'Mu\\u0308nster' give the same file"):
        check(["Münster", "Mu\u0308nster"])
    with pytest.raises(CatalogError, match="give the same file names"):
        check(["a/b", safe_name("a/b")])


@pytest.mark.parametrize("tile_id", ["-500_5600", "--help", "-", "/x", ".-a", "."])
def test_no_folder_begins_like_an_option_or_is_hidden(tile_id):
    name = safe_name(tile_id)
    assert name[0] not in "-."
    check([tile_id, "500_5600"])
    with pytest.raises(CatalogError, match="give the same file names"):
        check([tile_id, name])


def test_longest_id_gives_file_names_below_255_bytes():
    names = [safe_name(tile_id) for tile_id in ("x" * MAX_BYTES, "/" * MAX_BYTES, "道" * (MAX_BYTES // 3))]
    ends = [kind.suffix for several in KINDS.values() for kind in several]
    for name in names:
        for end in ends:
            file = f"{name}_{'v' * 80}{end}"
            assert len(f".{file}.{'0' * 32}.tmp".encode()) < 255


def test_printable_escapes_only_what_cannot_be_printed():
    assert printable("Straße 道 ✓ a b") == "Straße 道 ✓ a b"
    assert printable("a\x1b[2J\r\n\0\u202e\ud800") == r"a\x1b[2J\r\n\x00\u202e\ud800"
    assert shown("a" * 1000 + "\x1b").isprintable()
    assert len(shown([[["x" * 1000] * 100] * 100] * 100)) < 170
