"""Settings of object storage from the environment; wrong ones give one line with a remedy."""

import pytest

from flexroad.catalog.errors import CatalogError
from flexroad.catalog.storage.paths import parse_location
from flexroad.catalog.storage.settings import gdal_options, s3_options


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("AWS_ENDPOINT_URL", "localhost:9000"),
        ("AWS_ENDPOINT_URL_S3", "localhost"),
        ("AWS_ENDPOINT_URL", "://x"),
        ("AWS_ENDPOINT_URL", "http://"),
        ("AWS_ENDPOINT_URL", "ftp://a"),
        ("AWS_ENDPOINT_URL", "http://localhost:99999"),
        ("AWS_MAX_ATTEMPTS", "many"),
    ],
)
def test_wrong_setting_gives_one_line_with_remedy_for_buckets_only(name, value, monkeypatch, tmp_path):
    monkeypatch.setenv(name, value)
    with pytest.raises(CatalogError, match=f"{name} is '{value}'; set it to"):
        parse_location("s3://bucket/name")
    assert parse_location(tmp_path) == tmp_path
    # GDAL's options are set for files on disk, too.
    assert "AWS_S3_ENDPOINT" not in gdal_options()


def test_endpoint_in_upper_case_is_used(monkeypatch):
    monkeypatch.setenv("AWS_ENDPOINT_URL", "HTTPS://storage.example.org")
    assert gdal_options()["AWS_HTTPS"] == "YES"
    assert gdal_options()["AWS_S3_ENDPOINT"] == "storage.example.org"
    assert s3_options()["endpoint_url"] == "HTTPS://storage.example.org"
