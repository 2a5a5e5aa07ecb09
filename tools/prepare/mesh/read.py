"""Textured meshes of OBJ, PLY and glTF files.

A mesh that cannot be used is an error: no faces, no area, coordinates that are not finite, a wrong upward
axis, missing colours. Defects that change neither points nor orthophoto are accepted. A mesh that is inside
out gives a note; edges with more or fewer than two faces are not checked.
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from flexroad.catalog.grid import FARTHEST
from flexroad.catalog.lazy import lazy
from flexroad.catalog.scan.inputs import MESHES
from flexroad.catalog.text import access_reason
from flexroad.tasks import memory
from flexroad.tasks.errors import TaskError
from flexroad.tasks.types import Bools, Floats
from flexroad.tools.prepare.images import bounded
from flexroad.tools.prepare.mesh.georeference import Georeference, Offset, read_sidecar
from flexroad.tools.prepare.mesh.sample import TexturedMesh
from flexroad.tools.prepare.mesh.textures import FACTOR, Beside, Textures

trimesh = lazy("trimesh")

UPRIGHT = 2.0
"""Largest ratio of side area to plan area; above it the upward axis of the mesh is wrong."""
AXES = "xyz"
MOST_REPEATS = 1e6
"""Largest texture coordinate: number of repeats of a texture across a mesh."""
FACE_BYTES = 200
"""Memory of a face with its corners, colours and copies (bytes)."""
SMALLER = "divide the mesh, or use a coarser one"
MAGIC = b"glTF"
MOST_NODES = 100_000
"""Largest number of nodes and of primitives: trimesh makes an object for each."""
DEEPEST = 100
"""Largest depth of nodes: the place of a node is the product of all transforms above it."""


@dataclass(frozen=True, eq=False)
class _Part:
    """One geometry of a file, with at most one material."""

    vertices: Floats
    """In the file's frame, ``(V, 3)``."""
    faces: NDArray[np.int64]
    uv: NDArray[np.float32] | None
    """Texture coordinates of the corners, ``(F, 3, 2)``; None without a texture."""
    image: NDArray[np.uint8] | None
    """The texture, ``(h, w, 3)``; None without a texture."""
    colours: NDArray[np.uint8] | None
    """Colours of the corners, ``(F, 3, 3)``; None with a texture."""


def read_mesh(
    path: Path,
    up: Literal["y", "z"] | None = None,
    crs: str | None = None,
    offset: Offset | None = None,
    colours: bool = True,
) -> TexturedMesh:
    """Read a mesh and georeference it.

    - `path`: OBJ with its MTL and textures, PLY or glTF; may have several materials, and colours of vertices.
    - `up`: the file's upward axis; by default y in glTF, as its standard requires, and z elsewhere.
    - `crs`: CRS of the mesh; by default from the file (FlexRoad's GLB has a CRS) or its sidecar.
    - `offset`: easting, northing and height of the mesh's origin; by default from the same sources.
    - `colours`: whether colours are needed; if not, textures are not read.
    - result: in units of its CRS, which may be feet; every face has a colour if ``colours`` is True.
    """
    resolver = Beside(path)
    with _errors(path, resolver):
        scene = _scene(path, resolver)
        if colours and resolver.refused is not None:
            raise resolver.refused
        parts = list(_parts(path, scene, Textures(path) if colours else None))
    if not parts:
        raise TaskError(f"{path} has no faces; export a mesh, or its points as LAS or LAZ", file=str(path))
    vertices = np.concatenate([part.vertices for part in parts])
    if (up or ("y" if path.suffix.lower() in (".glb", ".gltf") else "z")) == "y":
        # Rotated, so that faces keep their orientation.
        vertices = vertices[:, [0, 2, 1]] * (1.0, -1.0, 1.0)
    counts = np.cumsum([0, *(len(part.vertices) for part in parts)])
    faces = np.concatenate([p.faces + first for p, first in zip(parts, counts, strict=False)])
    vertices, faces = _used(path, vertices, faces)
    notes = _check(path, vertices, faces)
    given = Georeference(crs, offset)
    georeference = given.with_fallback(_in_scene(scene)).with_fallback(read_sidecar(path))
    crs, placed = georeference.apply(path, vertices)
    return TexturedMesh(crs, placed, faces.astype(np.int32), *_colours(parts), notes)


@contextlib.contextmanager
def _errors(path: Path, resolver: Beside) -> Iterator[None]:
    """Context manager that turns the errors of trimesh into a `TaskError`."""
    try:
        with bounded(), np.errstate(all="ignore"):
            yield
    except (TaskError, ImportError):
        raise
    # For a damaged file, its readers raise exceptions of many types.
    except Exception as error:
        if resolver.refused is not None:
            raise resolver.refused from error
        if why := access_reason(error):
            raise TaskError(f"{path} {why}", file=str(path)) from error
        reason = " ".join(str(error).split())[:200]
        raise TaskError(
            f"{path} cannot be read as a mesh: {type(error).__name__}: {reason}; export it again",
            file=str(path),
        ) from error


def _scene(path: Path, resolver: Beside) -> Any:
    suffix = path.suffix.lower()
    if suffix not in MESHES:
        raise TaskError(
            f"{path} is not a mesh of a supported format ({', '.join(MESHES)}); convert it", file=str(path)
        )
    if not path.is_file():
        raise TaskError(f"{path} does not exist, or is not a file", file=str(path))
    size = path.stat().st_size
    memory.check(FACTOR * size, f"{path}, {size:,} bytes,", SMALLER, str(path))
    if suffix in (".glb", ".gltf"):
        elements = gltf_elements(path)
        memory.check(FACE_BYTES * elements, f"{path} with {elements:,} elements", SMALLER, str(path))
    with path.open("rb") as file:
        return trimesh.load_scene(file, file_type=suffix[1:], resolver=resolver, process=False)


def _parts(path: Path, scene: Any, images: Textures | None) -> Iterator[_Part]:
    """Yield the geometries of a scene; a geometry may be placed many times."""
    placed = [scene.graph[node] for node in sorted(scene.graph.nodes_geometry)]
    count = sum(len(getattr(scene.geometry[name], "faces", ())) for _, name in placed)
    memory.check(FACE_BYTES * count, f"{path} with {count:,} faces", SMALLER, str(path))
    for matrix, name in placed:
        if len(getattr(scene.geometry[name], "faces", ())):
            yield _part(path, scene.geometry[name], matrix, images)


def _part(path: Path, mesh: Any, matrix: Floats, images: Textures | None) -> _Part:
    vertices = np.asarray(mesh.vertices, np.float64) @ matrix[:3, :3].T + matrix[:3, 3]
    faces = np.asarray(mesh.faces, np.int64)
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise TaskError(
            f"{path} has faces with corners {faces.min()} to {faces.max()}, but {len(vertices)} vertices; "
            "export it again",
            file=str(path),
        )
    if images is None:
        return _Part(vertices, faces, None, None, None)
    visual, corners = mesh.visual, (len(faces), 3, 3)
    if visual.kind == "vertex":
        return _Part(vertices, faces, None, None, np.asarray(visual.vertex_colors)[faces, :3])
    if visual.kind == "face":
        colour = np.asarray(visual.face_colors)[:, None, :3]
        return _Part(vertices, faces, None, None, np.broadcast_to(colour, corners))
    image = images.texture(visual)
    uv = getattr(visual, "uv", None)
    if image is not None and uv is not None:
        return _Part(vertices, faces, _uv(path, uv, faces), image, None)
    if image is not None:
        raise TaskError(
            f"{path} has a texture but no texture coordinates; export it with UVs, or make no orthophoto: "
            "--no-dop",
            file=str(path),
        )
    plain = images.plain_colour(visual)
    if plain is None:
        raise TaskError(
            f"{path} has no colours; export it with a texture and UVs, or with vertex colours, or make no "
            "orthophoto: --no-dop",
            file=str(path),
        )
    return _Part(vertices, faces, None, None, np.broadcast_to(plain, corners))


def _uv(path: Path, uv: Any, faces: NDArray[np.int64]) -> NDArray[np.float32]:
    corners: NDArray[np.float32] = np.asarray(uv, np.float32)[faces]
    if corners.shape != (len(faces), 3, 2) or not (np.abs(corners) <= MOST_REPEATS).all():
        raise TaskError(
            f"{path} has texture coordinates that are not numbers, or beyond {MOST_REPEATS:g}; export it "
            "again, or make no orthophoto: --no-dop",
            file=str(path),
        )
    return corners


def _colours(
    parts: list[_Part],
) -> tuple[
    NDArray[np.int32],
    tuple[NDArray[np.uint8], ...],
    NDArray[np.float32] | None,
    NDArray[np.uint8] | None,
]:
    """Return the texture index of each face, the textures, texture coordinates and colours of all parts."""
    # Parts may share a texture, which is stored once.
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


def _in_scene(scene: Any) -> Georeference:
    """Return the georeference in a GLB written by FlexRoad (`tasks.products.glb`); empty in other files."""
    crs, origin = (scene.metadata.get(key) for key in ("crs", "run_origin"))
    if not isinstance(crs, str) or origin is None:
        return Georeference()
    east, north, up = map(float, origin)
    return Georeference(crs, (east, north, up))


def _used(path: Path, vertices: Floats, faces: NDArray[np.int64]) -> tuple[Floats, NDArray[np.int64]]:
    """Return the mesh without unused vertices, if one of them has no valid coordinates."""
    valid: Bools = np.asarray((np.abs(vertices) <= FARTHEST).all(axis=1))
    if valid.all():
        return vertices, faces
    used, indices = np.unique(faces, return_inverse=True)
    if not valid[used].all():
        far = vertices[used][~valid[used]][0]
        raise TaskError(
            f"{path} has faces with missing or non-finite corners, or beyond {FARTHEST:g}: one at "
            f"{', '.join(f'{axis:g}' for axis in far)}; remove it, or export the mesh again",
            file=str(path),
        )
    return vertices[used], indices.reshape(faces.shape)


def _check(path: Path, vertices: Floats, faces: NDArray[np.int64]) -> tuple[str, ...]:
    """Raise `TaskError` if the mesh cannot be used; return notes on harmless defects."""
    local = vertices - vertices[faces[0, 0]]
    a, b, c = (local[faces[:, corner]] for corner in range(3))
    normals = np.cross(b - a, c - a)
    projected = np.abs(normals).sum(axis=0)
    if not projected.any():
        raise TaskError(f"{path} has faces but no area; export it again", file=str(path))
    if projected[:2].max() > UPRIGHT * projected[2]:
        raise TaskError(
            f"{path} has a wrong upward axis: its projected area is "
            f"{projected[:2].max() / 2:.0f} from a side, but {projected[2] / 2:.0f} from above; "
            "set the axis: --up y or --up z",
            file=str(path),
        )
    if normals[:, 2].sum() < -0.5 * projected[2]:
        return (f"{path.name} is inside out: most faces point down; it is used unchanged",)
    return ()


def gltf_elements(path: Path) -> int:
    """Return the number of vertices and indices in memory after reading; each instance is counted."""
    header = _header(path)
    counts: list[int] = [_count(accessor) for accessor in header.get("accessors", [])]
    # Accessors without a view have no bytes in the file; they are filled with zeros.
    bare = sum(_count(accessor) for accessor in header.get("accessors", []) if "bufferView" not in accessor)
    meshes = [mesh["primitives"] for mesh in header.get("meshes", [])]
    nodes = header.get("nodes", [])
    if max(len(nodes), sum(map(len, meshes))) > MOST_NODES:
        raise ValueError(f"it has more than {MOST_NODES:,} nodes or primitives")
    _check_graph(nodes)
    sizes = [0] * len(meshes)
    for number, primitives in enumerate(meshes):
        for part in primitives:
            used = [*part.get("attributes", {}).values(), *([part["indices"]] if "indices" in part else [])]
            sizes[number] += sum(counts[index] for index in used)
    placed = sum(sizes[int(node["mesh"])] for node in nodes if "mesh" in node)
    return bare + sum(sizes) + placed


def _header(path: Path) -> dict[str, Any]:
    with path.open("rb") as file:
        head = file.read(20)
        if head[:4] == MAGIC:
            header = json.loads(file.read(int.from_bytes(head[12:16], "little")))
        else:
            header = json.loads(head + file.read())
    if not isinstance(header, dict):
        raise TypeError("its JSON is not an object")
    return header


def _count(accessor: dict[str, Any]) -> int:
    count = accessor["count"]
    if not isinstance(count, int) or count < 0:
        raise ValueError(f"an accessor has {str(count)[:50]} elements")
    return count


def _check_graph(nodes: list[dict[str, Any]]) -> None:
    """Check that the nodes form trees: at most one parent, and at most `DEEPEST` levels below a root."""
    children = [list(node.get("children", [])) for node in nodes]
    named = [child for each in children for child in each]
    if len(set(named)) < len(named) or not set(named) <= set(range(len(nodes))):
        raise ValueError("it has nodes that have two parents, or do not exist")
    level, reached = sorted(set(range(len(nodes))) - set(named)), 0
    for _ in range(DEEPEST):
        reached += len(level)
        level = [child for node in level for child in children[node]]
    if reached < len(nodes):
        raise ValueError(f"it has nodes below themselves, or more than {DEEPEST} levels of nodes")
