"""What matches a pattern below a folder, and which folders on the way cannot be listed."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path, PurePath


def glob(folder: Path, pattern: str) -> tuple[list[Path], list[tuple[Path, OSError]]]:
    """Return all that matches a glob pattern, and the folders that may hold more.

    Parameters
    ----------
    folder : Path
        Folder that the pattern is relative to.
    pattern : str

    Returns
    -------
    paths : list of Path
        Files, folders, and links to nothing, by name.
    unlisted : list of (Path, OSError)
        Folders on the pattern's way that cannot be listed, each with the error; `Path.glob` ignores them.

    Raises
    ------
    ValueError, NotImplementedError
        If the pattern is invalid.
    """
    paths = sorted(folder.glob(pattern))
    return paths, list(_unlisted(folder, pattern))


def _unlisted(folder: Path, pattern: str) -> Iterator[tuple[Path, OSError]]:
    above = PurePath(pattern).parts[:-1]
    places = {folder}
    for depth in range(1, len(above) + 1):
        places.update(folder.glob("/".join(above[:depth])))
    for place in sorted(places):
        try:
            with os.scandir(place):
                pass
        except (FileNotFoundError, NotADirectoryError):
            continue
        except OSError as error:
            yield place, error


def is_folder(path: Path) -> bool:
    """Return whether a path is a folder; what cannot be looked up is none."""
    # `Path.is_dir` raises an error for a name in a folder without permission.
    return os.path.isdir(path)  # noqa: PTH112
