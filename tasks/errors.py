"""The one base of what this package complains about."""

from __future__ import annotations


class TaskError(Exception):
    """A stage that cannot do its work on a tile; one line with the value and the remedy.

    Parameters
    ----------
    message : str
        One line.
    file : str, optional
        The source file at fault, for the table of failures.
    layer : str, optional
        The tile's layer at fault, where the stage knows no file: the runner names the layer's.
    """

    def __init__(self, message: str, file: str = "", layer: str = "") -> None:
        super().__init__(message)
        self.file = file
        self.layer = layer
