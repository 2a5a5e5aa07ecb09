"""The meshes of a run as LandXML 1.2: two TIN surfaces, road and ground, for civil engineering programs.

A file has one surface per class over all tiles, as such programs expect: with a surface per tile, 10,000 of
them would have to be joined by hand. The points of a surface stand before its faces, so that both are
collected in temporary files while the tiles pass. The memory in use grows with the outline of the tiles
written so far and not with their number: a vertex is remembered until the faces around it are complete.
"""

from __future__ import annotations

import gzip
import shutil
import tempfile
from collections.abc import Iterable
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
from flexroad.tasks.meshing.parts import Indices, part
from flexroad.tasks.types import Bools, Floats, Mesh

VERSION = 1
NAME = ".xml"
NAME_COMPRESSED = ".xml.gz"
MEDIA_TYPE = "application/xml"

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
POINT = '<P id="%d">%.4f %.4f %.4f</P>\n'
FACE = "<F>%d %d %d</F>\n"

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


def write(
    file: IO[bytes],
    meshes: Iterable[Mesh],
    project: Project,
    folder: Path | None = None,
    compress: bool = False,
) -> None:
    """Write the meshes of all tiles to one file.

    Points are "northing easting height", absolute, in metres, rounded to 0.05 mm. Faces are counter-clockwise
    from above. A class without faces has no surface. Equal inputs give equal bytes.

    Parameters
    ----------
    file : binary file object
        Open for writing.
    meshes : iterable of Mesh
        In any order, all in one CRS; each is read once. Memory is least if neighbours follow each other.
    project : Project
        Name, time and vertical CRS.
    folder : Path, optional
        Folder of the temporary files, which need as much space as the uncompressed file; by default that of
        the system.
    compress : bool
        Whether the file is compressed with gzip.

    Raises
    ------
    TaskError
        If no mesh has a face, or if two meshes have different CRSs.
    """
    with ExitStack() as stack:
        road, ground = (
            _Surface(name, meaning, _temporary(stack, folder), _temporary(stack, folder))
            for name, meaning in (("road", "Road surface"), ("ground", "Ground beside the road"))
        )
        system = _collect(meshes, (road, ground), project.joined)
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
        for surface in (road, ground):
            surface.copy_to(file)
        file.write(b"</Surfaces>\n</LandXML>\n")


def _temporary(stack: ExitStack, folder: Path | None) -> IO[bytes]:
    return stack.enter_context(tempfile.TemporaryFile(dir=folder))


def _collect(meshes: Iterable[Mesh], surfaces: tuple[_Surface, _Surface], joined: bool) -> str:
    """Add the faces of all meshes to the surfaces of road and ground; return the meshes' CRS."""
    system = ""
    open_vertices: dict[Place, _OpenVertex] = {}
    for mesh in meshes:
        system = system or mesh.crs
        if mesh.crs != system:
            raise TaskError(
                f"meshes in {crs.short(system)} and {crs.short(mesh.crs)} do not fit in one LandXML file;"
                " export each CRS to a file of its own"
            )
        at_rim = _at_rim(mesh, open_vertices) if joined else {}
        points = mesh.vertices + np.asarray(mesh.origin, np.float64)
        for number, (surface, faces) in enumerate(zip(surfaces, (mesh.road, ~mesh.road), strict=True)):
            surface.add(mesh, points, faces, number, at_rim)
        for vertex in at_rim.values():
            if vertex.angle > FULL_TURN:
                open_vertices.pop(vertex.place, None)
    if not any(surface.faces for surface in surfaces):
        raise TaskError("no tile has a mesh with a face; choose an area with tiles that succeeded")
    return system


@dataclass
class _OpenVertex:
    """A vertex at the rim of the meshes written so far."""

    place: Place
    angle: float = 0.0
    """Sum of the angles in plan of its faces (radians)."""
    numbers: list[int] = field(default_factory=lambda: [0, 0])
    """Its numbers in the surfaces of road and ground; 0 where it is not in them."""


def _at_rim(mesh: Mesh, open_vertices: dict[Place, _OpenVertex]) -> dict[int, _OpenVertex]:
    """Return the vertices at the rim of a mesh by their index; new ones are added to the open ones."""
    rim = _rim(mesh.faces)
    angles = _angles(mesh)
    places = np.rint((mesh.vertices[rim] + np.asarray(mesh.origin)) * 10**DECIMALS).astype(np.int64)
    found = {}
    for index, (x, y, z) in zip(rim.tolist(), places.tolist(), strict=True):
        vertex = open_vertices.setdefault((x, y, z), _OpenVertex((x, y, z)))
        vertex.angle += float(angles[index])
        found[index] = vertex
    return found


def _rim(faces: NDArray[np.int32]) -> Indices:
    """Return the vertices at edges with one face only."""
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    unique, uses = np.unique(edges, axis=0, return_counts=True)
    return np.unique(unique[uses == 1]).astype(np.intp)


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

    def add(
        self, mesh: Mesh, points: Floats, faces: Bools, number: int, at_rim: dict[int, _OpenVertex]
    ) -> None:
        """Write the faces of a mesh, and those of their points that no mesh before has written."""
        used, corners = part(mesh, faces)
        if not len(corners):
            return
        ids = np.zeros(len(used), np.int64)
        rim = [(k, at_rim[index]) for k, index in enumerate(used.tolist()) if index in at_rim]
        for k, vertex in rim:
            ids[k] = vertex.numbers[number]
        new = ids == 0
        ids[new] = self.points + 1 + np.arange(np.count_nonzero(new))
        for k, vertex in rim:
            vertex.numbers[number] = int(ids[k])
        east, north, height = points[used[new]].T
        _write_rows(self.points_file, POINT, (ids[new], north, east, height))
        _write_rows(self.faces_file, FACE, ids[corners].T)
        self.points += int(np.count_nonzero(new))
        self.faces += len(corners)
        heights = points[used, 2]
        self.low, self.high = min(self.low, heights.min()), max(self.high, heights.max())

    def copy_to(self, file: IO[bytes]) -> None:
        """Write the whole surface, if it has a face."""
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


def _write_rows(file: IO[bytes], row: str, columns: Iterable[NDArray[Any]]) -> None:
    """Write columns of numbers, each of their rows in the same format."""
    values = [column.tolist() for column in columns]
    file.write("".join(map(row.__mod__, zip(*values, strict=True))).encode())


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
