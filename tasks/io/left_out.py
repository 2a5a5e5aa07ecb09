"""The source files that a computation leaves out, because they cannot be used.

A result that was computed without a file is not the one that its name says, so the caller has to know of it.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from hashlib import sha256

import numpy as np

from flexroad.tasks.errors import Unusable
from flexroad.tasks.types import Bools

LeftOut = dict[tuple[str, str], str]
"""Notes on files by full name and by the hash of the cells that were left out; empty: the complete file."""
_RECORD: ContextVar[LeftOut | None] = ContextVar("_RECORD", default=None)


@contextmanager
def recorded() -> Iterator[LeftOut]:
    """Give the files that are left out until the block ends."""
    files = LeftOut()
    token = _RECORD.set(files)
    try:
        yield files
    finally:
        _RECORD.reset(token)


def leave_out(error: Unusable, cells: Bools | None = None) -> str:
    """Record that a file is left out, or only some cells of what was read of it, ``(rows, cols)``.

    - result: a note on it.
    """
    what, part = "a file", ""
    if cells is not None:
        what = "a part of a file"
        part = sha256(repr(cells.shape).encode() + np.packbits(cells).tobytes()).hexdigest()
    note = f"{what} that the tile does not need was left out: {error}"
    record = _RECORD.get()
    if record is not None:
        record[error.file, part] = note
    return note
