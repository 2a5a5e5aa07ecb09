"""Addresses in messages have no credentials."""

import os

import pytest

from flexroad.catalog import CatalogError
from flexroad.catalog.index import AllowedFolders
from flexroad.catalog.storage.paths import parse_location
from flexroad.catalog.storage.settings import s3_options
from flexroad.catalog.text import without_credentials
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.execute.dask import check_address

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
