"""Settings of object storage for s3fs and GDAL, from the environment.

Both read the usual variables ``AWS_...`` themselves; variables with another name there are passed on.
"""

from __future__ import annotations

import os
import re
from typing import Any
from urllib.parse import urlsplit

from flexroad.catalog.errors import CatalogError
from flexroad.catalog.text import shown, without_credentials

TRIES = 5
"""Attempts per request before it fails, unless AWS_MAX_ATTEMPTS is set."""
_YES = ("YES", "TRUE", "ON", "1")


def s3_options() -> dict[str, Any]:
    """Return the options of s3fs; it reads credentials and region itself, as AWS programs do."""
    config: dict[str, Any] = {
        # The other modes limit the retries per process; a long run would use them up.
        "retries": {"total_max_attempts": _tries(), "mode": os.environ.get("AWS_RETRY_MODE") or "legacy"},
        "connect_timeout": 10,
        "read_timeout": 60,
    }
    options: dict[str, Any] = {
        "config_kwargs": config,
        # Files that another process has just written must be listed.
        "use_listings_cache": False,
        "anon": os.environ.get("AWS_NO_SIGN_REQUEST", "").upper() in _YES,
    }
    if endpoint := _endpoint():
        # Private endpoints rarely have a host name per bucket.
        config["s3"] = {"addressing_style": "path"}
        options["endpoint_url"] = endpoint
    return options


def gdal_options() -> dict[str, str]:
    """Return GDAL's options for object storage; options set in the environment are left out.

    Wrong values are left out, too: files on disk do not need them, and `s3_options` reports them for buckets.
    """
    try:
        endpoint, tries = _endpoint(), _tries()
    except CatalogError:
        endpoint, tries = "", TRIES
    options = {
        # A file may change during a worker's life: drop its cached content when it is closed.
        "CPL_VSIL_CURL_NON_CACHED": "/vsis3/",
        "GDAL_HTTP_MAX_RETRY": str(tries - 1),
        "GDAL_HTTP_RETRY_DELAY": "0.5",
        # The status 0 means no answer.
        "GDAL_HTTP_RETRY_CODES": "0,429,500,502,503,504",
        "GDAL_HTTP_CONNECTTIMEOUT": "10",
        # Give up below 1 byte per second for a minute; large files are not affected.
        "GDAL_HTTP_LOW_SPEED_LIMIT": "1",
        "GDAL_HTTP_LOW_SPEED_TIME": "60",
    }
    if endpoint:
        options |= {
            "AWS_S3_ENDPOINT": urlsplit(endpoint).netloc,
            "AWS_HTTPS": "YES" if urlsplit(endpoint).scheme == "https" else "NO",
            "AWS_VIRTUAL_HOSTING": "FALSE",
        }
    return {name: value for name, value in options.items() if name not in os.environ}


def _endpoint() -> str:
    """Return the address of the storage's server, empty for AWS."""
    for name in ("AWS_ENDPOINT_URL_S3", "AWS_ENDPOINT_URL"):
        if address := os.environ.get(name):
            try:
                parts = urlsplit(address)
                fine = parts.scheme in ("http", "https") and parts.hostname and parts.port != 0
                fine = fine and parts.username is None
            except ValueError:
                fine = False
            if not fine:
                remedy = "set it to the server's address, as http://localhost:9000 or https://HOST"
                raise CatalogError(
                    f"{name} is {shown(without_credentials(address))}; {remedy}, without credentials"
                )
            return address
    return ""


def _tries() -> int:
    text = os.environ.get("AWS_MAX_ATTEMPTS") or str(TRIES)
    if not re.fullmatch(r"[1-9][0-9]{0,2}", text):
        raise CatalogError(f"AWS_MAX_ATTEMPTS is {shown(text)}; set it to a number from 1 to 999")
    return int(text)
