"""The date that vector files carry of their writing, for equal bytes of equal content."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from datetime import datetime

from flexroad.catalog.lazy import lazy

pyogrio = lazy("pyogrio")


@contextlib.contextmanager
def vector_date(date: datetime) -> Iterator[None]:
    """Make GDAL write a date (UTC) in place of the current one, as GeoPackages have; a context manager."""
    pyogrio.set_gdal_config_options({"OGR_CURRENT_DATE": f"{date:%Y-%m-%dT%H:%M:%SZ}"})
    try:
        yield
    finally:
        pyogrio.set_gdal_config_options({"OGR_CURRENT_DATE": None})
