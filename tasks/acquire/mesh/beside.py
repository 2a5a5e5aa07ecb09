"""Files that a mesh names: only those in its own folder or below are read."""

from __future__ import annotations

from pathlib import Path

from flexroad.tasks import memory
from flexroad.tasks.errors import TaskError

FACTOR = 8
"""Memory that reading a mesh takes, as a multiple of its files: text, numbers and copies of both."""


def beside(mesh: Path, name: str) -> Path:
    """Return a file that a mesh names.

    Raises
    ------
    TaskError
        If it lies outside the folder of the mesh, after links are resolved.
    """
    folder = mesh.parent.resolve()
    try:
        path = (folder / name).resolve()
        if path.is_relative_to(folder):
            return path
    except (OSError, RuntimeError, ValueError):
        # A name with a null byte, one that is too long, or a loop of links.
        pass
    raise TaskError(
        f"{mesh} needs the file {name[:200]!r}, which is not in its folder; copy it there and name it "
        "without folders, or make no orthophoto: --no-dop",
        file=str(mesh),
    )


class Beside:
    """Resolver for trimesh: gives it the material file or the buffers that a mesh names.

    trimesh goes on without files that it does not get, so that the reason is kept for the caller.
    """

    def __init__(self, mesh: Path) -> None:
        self.mesh = mesh
        self.file_name = mesh.name
        self.refused: TaskError | None = None

    def __getitem__(self, name: str) -> bytes:
        """Return the content of a file."""
        try:
            path = beside(self.mesh, name.strip())
        except TaskError as error:
            self.refused = error
            raise FileNotFoundError(name) from error
        if not path.is_file():
            raise FileNotFoundError(name)
        memory.check(FACTOR * path.stat().st_size, f"{path} of {self.mesh}", "use a smaller mesh", str(path))
        return path.read_bytes()

    def get(self, name: str) -> bytes:
        """Raise an error: images of OBJ and PLY are read by `Textures`."""
        raise FileNotFoundError(name)
