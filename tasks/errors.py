"""Errors of this package, and the source files that a computation leaves out because they cannot be used.

The caller must know of files that were left out, because the result then needs another name.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from hashlib import sha256

import numpy as np
from numpy.typing import NDArray

LeftOut = dict[tuple[str, str], str]
"""Notes on files by full name and hash of the cells that were left out; an empty hash: the complete file."""
_RECORD: ContextVar[LeftOut | None] = ContextVar("_RECORD", default=None)


class TaskError(Exception):
    """A stage that fails on a tile; one line with the value and the remedy.

    Parameters
    ----------
    message : str
        One line.
    file : str, optional
        The source file at fault, for the table of failures.
    layer : str, optional
        The tile's layer at fault, if the stage has no file name: the runner then reports the layer's files.
    """

    def __init__(self, message: str, file: str = "", layer: str = "") -> None:
        super().__init__(message)
        self.file = file
        self.layer = layer


class Unusable(TaskError):
    """A source file that is missing, broken, or unsuitable for its layer.

    Tiles that do not need the file leave it out.
    """


class LayerMissing(TaskError):
    """A tile lacks a layer that a stage needs. Around a border, the layer may end before the heights end."""


class MeshFault(TaskError):
    """A mesh that is not a height field triangulated once (`tasks.metrics.mesh_check`)."""


@contextmanager
def recorded() -> Iterator[LeftOut]:
    """Yield the files that are left out in the block."""
    files = LeftOut()
    token = _RECORD.set(files)
    try:
        yield files
    finally:
        _RECORD.reset(token)


def leave_out(error: Unusable, cells: NDArray[np.bool_] | None = None) -> str:
    """Record that a file is left out, or only some of its cells that were read, ``(rows, cols)``.

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
