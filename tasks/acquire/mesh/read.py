"""Textured meshes of OBJ, PLY and glTF files.

What makes a mesh useless here is an error: no faces, no area, coordinates that are no numbers, a surface
that stands upright, colours that are asked for and missing. What changes neither points nor the view from
above is not: a mesh that is inside out gets a note, edges of more or fewer than two faces are not looked at.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from flexroad.tasks.acquire.mesh.georeference import Offset, Placement, beside
from flexroad.tasks.acquire.mesh.sample import TexturedMesh
from flexroad.tasks.acquire.mesh.textures import Images
from flexroad.tasks.errors import TaskError
from flexroad.tasks.types import Floats

SUFFIXES = (".obj", ".ply", ".glb", ".gltf")
UPRIGHT = 2.0
"""A mesh of which so many times more is seen from a side than from above has another axis up."""
AXES = "xyz"


@dataclass(frozen=True, eq=False)
class _Part:
    """One geometry of a file, each with one material at most."""

    vertices: Floats
    """In the file's frame, ``(V, 3)``."""
    faces: NDArray[np.int64]
    uv: NDArray[np.float32] | None
    """Of the corners, ``(F, 3, 2)``."""
    image: NDArray[np.uint8] | None
    colours: NDArray[np.uint8] | None
    """Of the corners, ``(F, 3, 3)``."""


def read_mesh(
    path: Path,
    up: Literal["y", "z"] | None = None,
    crs: str | None = None,
    offset: Offset | None = None,
    colours: bool = True,
) -> TexturedMesh:
    """Read a mesh and put it in its place.

    Parameters
    ----------
    path : Path
        OBJ with its MTL and textures, PLY or glTF; several materials, vertex and plain colours are fine.
    up : str, optional
        The file's upward axis; by default y in glTF, as its makers want, and z elsewhere.
    crs : str, optional
        CRS of the mesh; by default what the file says (FlexRoad's own GLB does) or its sidecar.
    offset : tuple of float, optional
        Easting, northing and height of the mesh's zero; by default of the same sources.
    colours : bool
        Whether colours are wanted; if not, textures are not even looked for.

    Returns
    -------
    TexturedMesh
        In units of its CRS, which may be feet; every face has a colour if colours are wanted.

    Raises
    ------
    TaskError
        If there is no such mesh, no place for it, or no colour where some are wanted; with the remedy.
    """
    scene = _scene(path)
    images = Images(path) if colours else None
    parts = [
        _part(path, scene.geometry[name], matrix, images)
        for matrix, name in (scene.graph[node] for node in sorted(scene.graph.nodes_geometry))
        if len(getattr(scene.geometry[name], "faces", ()))
    ]
    if not parts:
        raise TaskError(f"{path} has no faces; export a mesh, or take points: prepare points", file=str(path))
    vertices = _z_up(np.concatenate([part.vertices for part in parts]), up or _usual_up(path))
    counts = np.cumsum([0, *(len(part.vertices) for part in parts)])
    faces = np.concatenate([p.faces + first for p, first in zip(parts, counts, strict=False)])
    notes = _check(path, vertices, faces)
    asked = Placement(crs, offset).over(_inside(scene)).over(beside(path))
    crs, placed = asked.apply(path, vertices)
    return TexturedMesh(crs, placed, faces.astype(np.int32), *_colours(parts), notes)


def _scene(path: Path) -> Any:
    import trimesh

    if path.suffix.lower() not in SUFFIXES:
        raise TaskError(f"{path} is none of {', '.join(SUFFIXES)}; convert it", file=str(path))
    if not path.is_file():
        raise TaskError(f"{path} does not exist", file=str(path))
    try:
        return trimesh.load_scene(path, process=False)
    # Its readers let through whatever a broken file makes them stumble over.
    except Exception as error:
        raise TaskError(
            f"{path} cannot be read as a mesh: {type(error).__name__}: {error}; export it again",
            file=str(path),
        ) from error


def _part(path: Path, mesh: Any, matrix: Floats, images: Images | None) -> _Part:
    turned = np.asarray(mesh.vertices, np.float64) @ matrix[:3, :3].T + matrix[:3, 3]
    faces = np.asarray(mesh.faces, np.int64)
    if images is None:
        return _Part(turned, faces, None, None, None)
    visual, corners = mesh.visual, (len(faces), 3, 3)
    if visual.kind == "vertex":
        return _Part(turned, faces, None, None, np.asarray(visual.vertex_colors)[faces, :3])
    if visual.kind == "face":
        colour = np.asarray(visual.face_colors)[:, None, :3]
        return _Part(turned, faces, None, None, np.broadcast_to(colour, corners))
    image = images.of(visual)
    uv = getattr(visual, "uv", None)
    if image is not None and uv is not None:
        return _Part(turned, faces, np.asarray(uv, np.float32)[faces], image, None)
    if image is not None:
        raise TaskError(
            f"{path} has a texture but no texture coordinates; export it with UVs, or leave the orthophoto "
            "out: --no-dop",
            file=str(path),
        )
    plain = images.plain(visual)
    if plain is None:
        raise TaskError(
            f"{path} has no colours: a texture with UVs, or colours of vertices, are wanted; export it with "
            "them, or leave the orthophoto out: --no-dop",
            file=str(path),
        )
    return _Part(turned, faces, None, None, np.broadcast_to(plain, corners))


def _colours(
    parts: list[_Part],
) -> tuple[
    NDArray[np.int32],
    tuple[NDArray[np.uint8], ...],
    NDArray[np.float32] | None,
    NDArray[np.uint8] | None,
]:
    """Return texture of each face, textures, texture coordinates and colours of all parts together."""
    # Parts may share a texture: it is held once.
    textures = {id(part.image): part.image for part in parts if part.image is not None}
    number = {key: n for n, key in enumerate(textures)}
    texture = np.concatenate([np.full(len(p.faces), number.get(id(p.image), -1), np.int32) for p in parts])
    uv = [p.uv if p.uv is not None else np.zeros((len(p.faces), 3, 2), np.float32) for p in parts]
    colours = [
        p.colours if p.colours is not None else np.zeros((len(p.faces), 3, 3), np.uint8) for p in parts
    ]
    return (
        texture,
        tuple(textures.values()),
        np.concatenate(uv) if textures else None,
        np.concatenate(colours) if any(p.colours is not None for p in parts) else None,
    )


def _inside(scene: Any) -> Placement:
    """Return what FlexRoad's own GLB says of its place (`tasks.export.glb`)."""
    crs, origin = (scene.metadata.get(key) for key in ("crs", "run_origin"))
    if not isinstance(crs, str) or origin is None:
        return Placement()
    east, north, up = map(float, origin)
    return Placement(crs, (east, north, up))


def _usual_up(path: Path) -> str:
    return "y" if path.suffix.lower() in (".glb", ".gltf") else "z"


def _z_up(vertices: Floats, up: str) -> Floats:
    """Turn (x, y, z) with y up into (x, -z, y): a rotation, so faces keep their side."""
    if up == "z":
        return vertices
    return vertices[:, [0, 2, 1]] * (1.0, -1.0, 1.0)


def _check(path: Path, vertices: Floats, faces: NDArray[np.int64]) -> tuple[str, ...]:
    """Raise what makes a mesh useless; return what is only odd."""
    if faces.min() < 0 or faces.max() >= len(vertices) or not np.isfinite(vertices[np.unique(faces)]).all():
        raise TaskError(
            f"{path} has faces with corners that are missing or no numbers; export it again", file=str(path)
        )
    small = vertices - vertices[faces[0, 0]]
    a, b, c = (small[faces[:, corner]] for corner in range(3))
    normals = np.cross(b - a, c - a)
    seen = np.abs(normals).sum(axis=0)
    if not seen.any():
        raise TaskError(f"{path} has faces but no area; export it again", file=str(path))
    if seen[:2].max() > UPRIGHT * seen[2]:
        raise TaskError(
            f"{path} stands upright: {seen[:2].max() / 2:.0f} of its surface show from a side, "
            f"{seen[2] / 2:.0f} from above; turn it: --up y or --up z",
            file=str(path),
        )
    if normals[:, 2].sum() < -0.5 * seen[2]:
        return (f"{path.name} is inside out: most faces look down; taken as it lies",)
    return ()
