"""Inputs for rasters: point clouds, a mesh, an OpenDroneMap project, photographs."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from pathlib import Path

from flexroad.catalog.errors import CatalogError
from flexroad.catalog.text import some

POINTS = (".las", ".laz")
MESHES = (".obj", ".ply", ".glb", ".gltf")
SUFFIXES = {"points": POINTS, "mesh": MESHES, "photos": (".jpg", ".jpeg", ".png", ".tif", ".tiff")}
"""Kind of input -> endings of its files."""
TITLES = {"points": "point clouds", "mesh": "a mesh", "photos": "photographs", "odm": "an ODM project"}
ACCEPTED = ", ".join(f"{TITLES[kind]} ({', '.join(endings)})" for kind, endings in SUFFIXES.items())
ACCEPTED += ", folders of them, or the folder of an OpenDroneMap project"
PROJECT = ("odm_dem", "odm_orthophoto", "odm_georeferencing", "odm_texturing")
"""Folders of an OpenDroneMap project."""


def is_project(folder: Path) -> bool:
    """Return whether a folder is an OpenDroneMap project."""
    return any((folder / name).is_dir() for name in PROJECT)


def recognised(inputs: Collection[Path]) -> tuple[str, list[Path]]:
    """Return the kind of inputs, a key of `TITLES`, and their places; for a mesh its only file."""
    examples: dict[tuple[str, ...], Path] = {}
    for path in inputs:
        examples.setdefault(_kinds(path), path)
    known = {kind for kinds in examples for kind in kinds}
    if len(known) != 1 or () in examples:
        found = (
            f"{path} has {' and '.join(TITLES[kind] for kind in kinds) or 'no known input'}"
            for kinds, path in examples.items()
        )
        raise CatalogError(f"{', '.join(found)}; give inputs of one kind: {ACCEPTED}")
    (kind,) = known
    places = files_of(inputs, kind) if kind == "mesh" else [*inputs]
    if kind in ("mesh", "odm") and len(places) > 1:
        raise CatalogError(f"{some([str(path) for path in places])}: give {TITLES[kind]} alone")
    return kind, places


def files_of(inputs: Iterable[Path], kind: str) -> list[Path]:
    """Return the files of a kind, given as files or folders, each once."""
    files: dict[Path, None] = {}
    for path in inputs:
        inside = [file for file in _files(path) if file == path or file.suffix.lower() in SUFFIXES[kind]]
        if not inside:
            raise CatalogError(f"{path} has no {TITLES[kind]} ({', '.join(SUFFIXES[kind])})")
        files.update(dict.fromkeys(inside))
    return [*files]


def _files(path: Path) -> list[Path]:
    if not path.exists():
        raise CatalogError(f"{path} does not exist; give {ACCEPTED}")
    return sorted(path.iterdir()) if path.is_dir() else [path]


def _kinds(path: Path) -> tuple[str, ...]:
    """Return the kinds of input that a file or folder has."""
    if is_project(path):
        return ("odm",)
    endings = {file.suffix.lower() for file in _files(path)}
    kinds = tuple(kind for kind, known in SUFFIXES.items() if not endings.isdisjoint(known))
    # Images in the folder of a mesh or of points are textures or previews.
    return kinds[:-1] if len(kinds) > 1 and kinds[-1] == "photos" else kinds
