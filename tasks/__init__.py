"""What happens to one tile: pure functions from the paper's inputs to its meshes and figures."""

from tasks.errors import TaskError

__all__ = ["TaskError"]
