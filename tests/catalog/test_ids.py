"""Ids of tiles, the file names made from them, and texts in messages."""

import os
import re

import pytest

from flexroad.catalog import CatalogError
from flexroad.catalog.ids import MAX_BYTES, check, problem, safe_name
from flexroad.catalog.storage.paths import parse_location
from flexroad.catalog.storage.settings import s3_options
from flexroad.catalog.text import printable, shown, without_credentials
from flexroad.catalog.trust import AllowedFolders
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.execute.dask import check_address
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


@pytest.mark.parametrize(
    "tile_id", ["295500_5629250", "a b", "ü" * 50, "x" * 100, "../a", ".", "a/b", "道路"]
)
def test_usable_ids(tile_id):
    assert not problem(tile_id)
    check([tile_id, "b"])


def test_unusable_and_equal_ids_are_named_with_a_remedy():
    with pytest.raises(CatalogError, match=r"'a\\n' has characters .*; rename the tile in its source"):
        check(["a", "a\n"])
    with pytest.raises(CatalogError, match="but a, c occur more than once; rename those tiles"):
        check(["a", "b", "c", "a", "c"])
    with pytest.raises(CatalogError, match=r"tile ids 'M\\xfcnster', 'Mu\\u0308nster' give the same file"):
        check(["Münster", "Mu\u0308nster"])
    with pytest.raises(CatalogError, match="give the same file names"):
        check(["a/b", safe_name("a/b")])


@pytest.mark.parametrize(
    "tile_id", ["-500_5600", "--help", "-", "/x", ".-a", ".", "..", "../up", "a/b", "ä b"]
)
def test_no_folder_begins_like_an_option_is_hidden_or_lies_elsewhere(tile_id):
    name = safe_name(tile_id)
    assert name[0] not in "-."
    assert "/" not in name
    assert safe_name("500_5600") == "500_5600"
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


SECRET = "wJalr/XUtn+FEMI"
"""Keys of AWS may have slashes."""


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        (f"s3://AKIA:{SECRET}@bucket/run is damaged", "s3://***@bucket/run is damaged"),
        (f"s3:/AKIA:{SECRET}@bucket/run", "s3:/***@bucket/run"),
        ("https://me:pw@host/a.tif, ftp://pw@host/b", "https://***@host/a.tif, ftp://***@host/b"),
        (f"'tls://me:{SECRET}@host:8786' is", "'tls://***@host:8786' is"),
        (f"me:{SECRET}@host:8786", "***@host:8786"),
        ("https://host/a.tif?sig=abc&se=1 is", "https://host/a.tif?*** is"),
        ("s3://bucket/a@2x.tif", "s3://bucket/a@2x.tif"),
        ("/data/a@2x.tif: tile 1, me@example.org?", "/data/a@2x.tif: tile 1, me@example.org?"),
    ],
)
def test_addresses_are_shown_without_credentials(text, shown):
    assert without_credentials(text) == shown


@pytest.mark.parametrize(
    "take",
    [
        lambda: parse_location(f"s3://AKIA:{SECRET}@bucket/catalog.parquet"),
        lambda: parse_location(f"https://me:{SECRET}@host/catalog.parquet"),
        lambda: AllowedFolders.of("/survey", [f"s3://AKIA:{SECRET}@bucket"]),
        lambda: check_address(f"tls://me:{SECRET}@host:8786"),
        lambda: check_address("tcp://wJalr@host:8786"),
        s3_options,
    ],
)
def test_address_with_credentials_is_refused_without_them(take, monkeypatch):
    monkeypatch.setitem(os.environ, "AWS_ENDPOINT_URL", f"https://me:{SECRET}@host")
    with pytest.raises((CatalogError, ConfigError)) as raised:
        take()
    assert "***@" in str(raised.value)
    assert "wJalr" not in str(raised.value)


@pytest.mark.parametrize("place", ["--catalog", "--out", "--store", "--executor"])
def test_commands_show_no_credentials(flexroad, survey, tmp_path, place):
    words = {"--catalog": survey, "--out": tmp_path / "run"}
    words[place] = f"s3://AKIA:{SECRET}@bucket/x"
    said = flexroad("run", *(word for option in words.items() for word in option))
    assert said.code == 2
    assert "***@" in said.err
    assert "wJalr" not in said.out + said.err
