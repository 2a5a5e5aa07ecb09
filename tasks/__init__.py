"""The work on one tile: pure functions from the paper's inputs to its meshes and figures."""

from flexroad.tasks.errors import TaskError

__all__ = ["TaskError"]
