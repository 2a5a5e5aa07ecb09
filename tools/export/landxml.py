"""The meshes of a run as LandXML 1.2: two TIN surfaces, road and ground, for civil engineering programs.

A file has one surface per class over all tiles, as such programs expect: with a surface per tile, 10,000 of
them would have to be joined by hand. So the work has two steps: `part` makes what a single mesh gives, and
`join` numbers the points of all parts. The points of a surface stand before its faces, so that both are
collected in temporary files while the parts pass. The memory in use grows with the outline of the tiles
written so far and not with their number: a vertex is remembered until the faces around it are complete.
"""

from __future__ import annotations

import gzip
import io
import shutil
import tempfile
from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import IO, Any, cast
from xml.sax.saxutils import quoteattr

import numpy as np
from numpy.typing import NDArray

from flexroad.catalog import crs
from flexroad.catalog.text import printable
from flexroad.tasks.errors import TaskError
from flexroad.tasks.types import Bools, Floats, Mesh

VERSION = 1
NAME = ".xml"
NAME_COMPRESSED = ".xml.gz"

DECIMALS = 4
"""Decimals of coordinates (m): they are rounded to 0.05 mm."""
FULL_TURN = 2 * np.pi - 1e-6
"""Sum of the angles around a vertex from which on its faces are complete (radians)."""

HEAD = """\
<?xml version="1.0" encoding="UTF-8"?>
<LandXML xmlns="http://www.landxml.org/schema/LandXML-1.2" \
xmlns:xsi="http://www.w3.org/2001/XMLSchema-instance" \
xsi:schemaLocation="http://www.landxml.org/schema/LandXML-1.2 \
http://www.landxml.org/schema/LandXML-1.2/LandXML-1.2.xsd" version="1.2" language="English" readOnly="false" \
date="{date}" time="{time}">
<Units><Metric areaUnit="squareMeter" linearUnit="meter" volumeUnit="cubicMeter" temperatureUnit="celsius" \
pressureUnit="HPA" elevationUnit="meter"/></Units>
<CoordinateSystem {system}/>
<Project name={project}/>
<Application name="FlexRoad"/>
<Surfaces>
"""
SURFACE = """\
<Surface name={name} desc={meaning}>
<Definition surfType="TIN" elevMin="{low:.4f}" elevMax="{high:.4f}">
<Pnts>
"""
POINT_START, POINT_END = b'<P id="%d">%b\n', "%.4f %.4f %.4f</P>\n"
FACE = b"<F>%d %d %d</F>\n"
CLASSES = (("road", "Road surface"), ("ground", "Ground beside the road"))
"""Name and meaning of the surfaces."""
LEVEL = "level"
"""Begin of the names of the other levels in a part's archive."""

Place = tuple[int, int, int]
"""Easting, northing and height in units of the last decimal."""


@dataclass(frozen=True)
class Project:
    """What the head of a file says."""

    name: str
    written: datetime
    """Date and time of the file, which the format requires."""
    vertical: str | None = None
    """CRS of the heights, or None if it is not known."""
    joined: bool = True
    """Whether the meshes have common vertices at their borders, which the surfaces then share."""


@dataclass(frozen=True, eq=False)
class PartSurface:
    """The faces of one class of one mesh."""

    points: bytes
    """The end of the line of each point, from its northing on; of n points."""
    corners: NDArray[np.int32]
    """Numbers of points, from 0, ``(k, 3)``."""
    rim: NDArray[np.int32]
    """Of each point at the rim of the mesh: its number here, and its row in the part's rim, ``(r, 2)``."""
    limits: Floats
    """Lowest and highest height (m), ``(2,)``."""


@dataclass(frozen=True, eq=False)
class Part:
    """What one mesh gives to a file."""

    crs: str
    places: NDArray[np.int64]
    """Easting, northing and height of the vertices at its rim, in units of the last decimal, ``(R, 3)``."""
    angles: Floats
    """Sum of the angles in plan of the faces around each of them (radians), ``(R,)``."""
    surfaces: tuple[PartSurface, PartSurface]
    """Road and ground."""
    levels: tuple[tuple[int, Part], ...] = ()
    """Number and part of each other level, which has a road alone."""

    def encode(self) -> bytes:
        """Return the part as NumPy archive, for `decode`."""
        arrays = {"crs": np.array(self.crs), "places": self.places, "angles": self.angles}
        for number, surface in enumerate(self.surfaces):
            arrays[f"points{number}"] = np.frombuffer(surface.points, np.uint8)
            arrays |= {f"{name}{number}": getattr(surface, name) for name in ("corners", "rim", "limits")}
        for number, other in self.levels:
            arrays[f"{LEVEL}{number}"] = np.frombuffer(other.encode(), np.uint8)
        buffer = io.BytesIO()
        np.savez(buffer, **arrays)  # type: ignore[arg-type]  # its flags are named like no array
        return buffer.getvalue()

    @classmethod
    def decode(cls, data: bytes) -> Part:
        """Return the part that `encode` has written."""
        with np.load(io.BytesIO(data), allow_pickle=False) as npz:
            road, ground = (
                PartSurface(
                    npz[f"points{k}"].tobytes(), npz[f"corners{k}"], npz[f"rim{k}"], npz[f"limits{k}"]
                )
                for k in range(2)
            )
            levels = tuple(
                (int(name.removeprefix(LEVEL)), cls.decode(npz[name].tobytes()))
                for name in npz.files
                if name.startswith(LEVEL)
            )
            return cls(str(npz["crs"]), npz["places"], npz["angles"], (road, ground), levels)


def part(mesh: Mesh, joined: bool = True) -> Part:
    """Return what a mesh gives to a file: all of it but the numbers of its points.

    - `joined`: whether it shares the vertices at its border with its neighbours (`Project.joined`).
    """
    levels = tuple((number, part(mesh.at(number), joined)) for number in mesh.numbers[1:])
    mesh = mesh.at(0)
    points = mesh.vertices + np.asarray(mesh.origin, np.float64)
    rim = _rim(mesh) if joined else np.zeros(0, np.intp)
    row = np.full(len(points), -1, np.int32)
    row[rim] = np.arange(len(rim))
    places = np.rint(points[rim] * 10**DECIMALS).astype(np.int64)
    road, ground = (_part_surface(mesh, faces, points, row) for faces in (mesh.road, ~mesh.road))
    return Part(mesh.crs, places, _angles(mesh)[rim], (road, ground), levels)


def _part_surface(mesh: Mesh, faces: Bools, points: Floats, row: NDArray[np.int32]) -> PartSurface:
    used, corners = mesh.part(faces)
    east, north, height = points[used].T
    columns = zip(north.tolist(), east.tolist(), height.tolist(), strict=True)
    text = "".join(map(POINT_END.__mod__, columns)).encode()
    at_rim = np.flatnonzero(row[used] >= 0).astype(np.int32)
    rim = np.column_stack([at_rim, row[used][at_rim]])
    limits = np.array([height.min(), height.max()] if len(used) else [np.inf, -np.inf])
    return PartSurface(text, corners, rim, limits)


def join(
    file: IO[bytes],
    parts_of_meshes: Iterable[Part],
    project: Project,
    folder: Path | None = None,
    compress: bool = False,
) -> None:
    """Write the parts of all meshes to one file.

    Points are "northing easting height", absolute, in metres, rounded to 0.05 mm. Faces are counter-clockwise
    from above. A class without faces has no surface. Equal inputs give equal bytes.

    - `parts_of_meshes`: in any order, all in one CRS; each is read once. Memory is least if neighbours follow
      each other.
    - `folder`: folder of the temporary files, which need as much space as the uncompressed file; by default
      that of the system.
    """
    with ExitStack() as stack:

        def surfaces_of(number: int) -> list[_Surface]:
            level = f" level {number}" if number else ""
            return [
                _Surface(name + level, meaning + level, _temporary(stack, folder), _temporary(stack, folder))
                for name, meaning in CLASSES
            ]

        surfaces = {0: surfaces_of(0)}
        system = _collect(parts_of_meshes, surfaces, surfaces_of)
        if compress:
            # Name and time of the archive are left out: equal inputs give equal bytes.
            packed = gzip.GzipFile(filename="", mode="wb", fileobj=file, compresslevel=6, mtime=0)
            file = stack.enter_context(cast(IO[bytes], packed))
        head = HEAD.format(
            date=f"{project.written:%Y-%m-%d}",
            time=f"{project.written:%H:%M:%S}",
            system=_coordinate_system(system, project.vertical),
            project=_quoted(project.name),
        )
        file.write(head.encode())
        for number in sorted(surfaces, key=lambda number: (number != 0, number)):
            for surface in surfaces[number]:
                surface.copy_to(file)
        file.write(b"</Surfaces>\n</LandXML>\n")


def _temporary(stack: ExitStack, folder: Path | None) -> IO[bytes]:
    return stack.enter_context(tempfile.TemporaryFile(dir=folder))


def _collect(
    parts_of_meshes: Iterable[Part],
    surfaces: dict[int, list[_Surface]],
    surfaces_of: Callable[[int], list[_Surface]],
) -> str:
    """Add the faces of all parts to the surfaces of their level; return the meshes' CRS.

    - `surfaces`: road and ground of each level; those of further levels are added.
    """
    system = ""
    open_vertices: dict[int, dict[Place, _OpenVertex]] = {}
    for one in parts_of_meshes:
        system = system or one.crs
        if one.crs != system:
            raise TaskError(
                f"meshes in {crs.short(system)} and {crs.short(one.crs)} do not fit in one LandXML file;"
                " export each CRS to a file of its own"
            )
        for level, own in ((0, one), *one.levels):
            if level not in surfaces:
                surfaces[level] = surfaces_of(level)
            _add(own, surfaces[level], open_vertices.setdefault(level, {}))
    if not any(surface.faces for surface in surfaces[0]):
        raise TaskError("no tile has a mesh with a face; choose an area with tiles that succeeded")
    return system


def _add(own: Part, surfaces: Sequence[_Surface], open_vertices: dict[Place, _OpenVertex]) -> None:
    """Add the faces of a part of one level to its surfaces."""
    at_rim = _at_rim(own, open_vertices)
    for number, (surface, faces) in enumerate(zip(surfaces, own.surfaces, strict=True)):
        surface.add(faces, number, at_rim)
    for vertex in at_rim:
        if vertex.angle > FULL_TURN:
            open_vertices.pop(vertex.place, None)


@dataclass
class _OpenVertex:
    """A vertex at the rim of the meshes written so far."""

    place: Place
    angle: float = 0.0
    """Sum of the angles in plan of its faces (radians)."""
    numbers: list[int] = field(default_factory=lambda: [0, 0])
    """Its numbers in the surfaces of road and ground; 0 where it is not in them."""


def _at_rim(one: Part, open_vertices: dict[Place, _OpenVertex]) -> list[_OpenVertex]:
    """Return the vertices at the rim of a part, in its order; new ones are added to the open ones."""
    found = []
    for (x, y, z), angle in zip(one.places.tolist(), one.angles.tolist(), strict=True):
        vertex = open_vertices.setdefault((x, y, z), _OpenVertex((x, y, z)))
        vertex.angle += angle
        found.append(vertex)
    return found


def _rim(mesh: Mesh) -> NDArray[np.intp]:
    """Return the vertices at edges with one face only."""
    faces = mesh.faces.astype(np.int64)
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    # One number per edge: rows are sorted ten times slower.
    unique, uses = np.unique(edges[:, 0] * len(mesh.vertices) + edges[:, 1], return_counts=True)
    single = unique[uses == 1]
    return np.unique(np.divmod(single, len(mesh.vertices))).astype(np.intp)


def _angles(mesh: Mesh) -> Floats:
    """Return the sum of the angles in plan of the faces around each vertex, ``(V,)`` (radians)."""
    total = np.zeros(len(mesh.vertices))
    corners = mesh.vertices[mesh.faces][..., :2]
    for k in range(3):
        a = corners[:, (k + 1) % 3] - corners[:, k]
        b = corners[:, (k + 2) % 3] - corners[:, k]
        cross = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
        np.add.at(total, mesh.faces[:, k], np.arctan2(np.abs(cross), (a * b).sum(axis=1)))
    return total


@dataclass
class _Surface:
    """One class of faces over all tiles."""

    name: str
    meaning: str
    points_file: IO[bytes]
    faces_file: IO[bytes]
    points: int = 0
    faces: int = 0
    low: float = np.inf
    high: float = -np.inf

    def add(self, part: PartSurface, number: int, at_rim: Sequence[_OpenVertex]) -> None:
        """Write the faces of a part, and those of their points that no part before has written."""
        if not len(part.corners):
            return
        lines = part.points.splitlines()
        ids = np.zeros(len(lines), np.int64)
        rim = [(point, at_rim[row]) for point, row in part.rim.tolist()]
        for point, vertex in rim:
            ids[point] = vertex.numbers[number]
        new = np.flatnonzero(ids == 0)
        ids[new] = self.points + 1 + np.arange(len(new))
        for point, vertex in rim:
            vertex.numbers[number] = int(ids[point])
        _write_rows(self.points_file, POINT_START, [ids[new].tolist(), [lines[k] for k in new.tolist()]])
        _write_rows(self.faces_file, FACE, ids[part.corners].T.tolist())
        self.points += len(new)
        self.faces += len(part.corners)
        low, high = part.limits.tolist()
        self.low, self.high = min(self.low, low), max(self.high, high)

    def copy_to(self, file: IO[bytes]) -> None:
        """Write the complete surface, if it has a face."""
        if not self.faces:
            return
        start = SURFACE.format(
            name=_quoted(self.name), meaning=_quoted(self.meaning), low=self.low, high=self.high
        )
        file.write(start.encode())
        _copy(self.points_file, file)
        file.write(b"</Pnts>\n<Faces>\n")
        _copy(self.faces_file, file)
        file.write(b"</Faces>\n</Definition>\n</Surface>\n")


def _write_rows(file: IO[bytes], row: bytes, columns: Sequence[Sequence[Any]]) -> None:
    """Write columns of values, each of their rows in the same format."""
    file.write(b"".join(map(row.__mod__, zip(*columns, strict=True))))


def _copy(source: IO[bytes], target: IO[bytes]) -> None:
    source.seek(0)
    shutil.copyfileobj(source, target, 1 << 20)


def _coordinate_system(plan: str, vertical: str | None) -> str:
    """Return the attributes of CoordinateSystem: EPSG code, or WKT where there is none."""
    attributes = {"name": crs.name(plan), "horizontalDatum": crs.datum(plan)}
    epsg = crs.code(plan)
    attributes |= {"epsgCode": epsg} if epsg else {"ogcWktCode": " ".join(plan.split())}
    if vertical:
        attributes |= {
            "verticalDatum": crs.datum(vertical),
            "verticalCoordinateSystemName": crs.name(vertical),
        }
    return " ".join(f"{key}={_quoted(value)}" for key, value in attributes.items())


def _quoted(text: str) -> str:
    return quoteattr(printable(text))
