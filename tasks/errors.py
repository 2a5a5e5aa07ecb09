"""The base class of this package's errors."""

from __future__ import annotations


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
    """A source file that is missing or broken, or does not have what its layer needs.

    Tiles that do not need it leave it out.
    """


class LayerMissing(TaskError):
    """A tile lacks a layer that a stage needs; around a border of tiles it may end before the heights do."""


class MeshFault(TaskError):
    """A mesh that is no height field triangulated once (`tasks.metrics.mesh_check`)."""
