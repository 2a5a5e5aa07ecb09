"""Values of columns, or of OSM's tags, in tables of roads."""

from __future__ import annotations

from typing import Any

import numpy as np

from flexroad.tasks.types import Bools

NO = ("", "no", "false", "f", "n", "0", "0.0", "nan", "<na>", "none")
"""Values that mean no, or no value, in lower case."""


def has_value(value: Any) -> bool:
    """Return whether a table has a value there."""
    # pandas has several values for "missing".
    return value is not None and str(value).strip().lower() not in ("", "nan", "<na>", "none")


def is_yes(table: Any, column: str) -> Bools:
    """Return the rows whose value in a column is not one of `NO`, ``(n,)``; none if the column is missing."""
    if column not in table:
        return np.zeros(len(table), bool)
    return np.array([str(value).strip().lower() not in NO for value in table[column]], bool)
