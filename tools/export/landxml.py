"""The meshes of a run as LandXML 1.2: two TIN surfaces, road and ground, for civil engineering programs.

A file has one surface per class over all tiles: users would have to join surfaces of single tiles by hand.
The work has two steps: `part` prepares a single mesh, and `join` numbers the points of all parts.
In the file the points of a surface precede its faces. So both are first collected in temporary files.
A vertex is kept in memory only until the faces around it are complete. So the memory grows with the outline
of the tiles written so far, and not with their number.
"""

from __future__ import annotations

import gzip
import io
import shutil
import tempfile
from collections import defaultdict
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
from flexroad.tasks.types import Floats, Mesh

VERSION = 1
NAME = ".xml"
NAME_COMPRESSED = ".xml.gz"

DECIMALS = 4
"""Decimals of coordinates (m): the rounding error is at most 0.05 mm."""
FULL_TURN = 2 * np.pi - 1e-6
"""The faces around a vertex are complete if the sum of their angles reaches this (radians)."""

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

Arrays = dict[str, NDArray[Any]]
Place = tuple[int, int, int]
"""Easting, northing and height in units of the last decimal."""


@dataclass(frozen=True)
class Project:
    """The head of a file."""

    name: str
    written: datetime
    """Date and time of the file, which the format requires."""
    vertical: str | None = None
    """CRS of the heights; None if unknown."""
    joined: bool = True
    """Whether neighbouring meshes have common vertices at their borders; then each is written once."""


def part(mesh: Mesh, joined: bool = True) -> bytes:
    """Return the part of a mesh in a file, still without the numbers of its points, as NumPy archive.

    It has the arrays of `_part` of each level, named ``LEVEL.NAME``, and the CRS.

    - `joined`: whether it shares the vertices at its border with its neighbours (`Project.joined`).
    """
    arrays: Arrays = {"crs": np.array(mesh.crs)}
    for level in mesh.numbers:
        arrays |= {f"{level}.{name}": values for name, values in _part(mesh.at(level), joined).items()}
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)  # type: ignore[arg-type]  # no array has the name of a flag
    return buffer.getvalue()


def _part(mesh: Mesh, joined: bool) -> Arrays:
    """Return the part of the mesh of one level in a file.

    - `places` ``(R, 3)``: vertices at its rim: easting, northing, height in units of the last decimal.
    - `angles` ``(R,)``: sums of the angles in plan of the faces around them (radians).
    - `points0`, `points1`: for road and ground, the text of each point's line from the northing on.
    - `corners0`, `corners1` ``(k, 3)``: numbers of points, from 0.
    - `rim0`, `rim1` ``(r, 2)``: the number of each point at the rim, and its row in `places`.
    - `limits0`, `limits1` ``(2,)``: lowest and highest height (m).
    """
    points = mesh.vertices + np.asarray(mesh.origin, np.float64)
    rim = _rim(mesh) if joined else np.zeros(0, np.intp)
    row = np.full(len(points), -1, np.int32)
    row[rim] = np.arange(len(rim))
    places = np.rint(points[rim] * 10**DECIMALS).astype(np.int64)
    arrays = {"places": places, "angles": _angles(mesh)[rim]}
    for number, faces in enumerate((mesh.road, ~mesh.road)):
        used, corners = mesh.part(faces)
        east, north, height = points[used].T
        columns = zip(north.tolist(), east.tolist(), height.tolist(), strict=True)
        text = "".join(map(POINT_END.__mod__, columns)).encode()
        at_rim = np.flatnonzero(row[used] >= 0).astype(np.int32)
        arrays |= {
            f"points{number}": np.frombuffer(text, np.uint8),
            f"corners{number}": corners,
            f"rim{number}": np.column_stack([at_rim, row[used][at_rim]]),
            f"limits{number}": np.array([height.min(), height.max()] if len(used) else [np.inf, -np.inf]),
        }
    return arrays


def join(
    file: IO[bytes],
    parts_of_meshes: Iterable[bytes],
    project: Project,
    folder: Path | None = None,
    compress: bool = False,
) -> None:
    """Write the parts of all meshes to one file.

    Points are "northing easting height", absolute, in metres, rounded to 0.05 mm. Faces are counter-clockwise
    from above. A class without faces has no surface. Equal inputs give equal bytes.

    - `parts_of_meshes`: results of `part`, all in one CRS, in any order; each is read once. Least memory is
      used if neighbours follow each other.
    - `folder`: folder of the temporary files, which need as much space as the uncompressed file; by default
      the system's folder.
    """
    with ExitStack() as stack:
        surfaces = dict[int, list[_Surface]]()

        def surfaces_of(number: int) -> list[_Surface]:
            """Return road and ground of a level."""
            level = f" level {number}" if number else ""
            for name, meaning in CLASSES if number not in surfaces else ():
                points, faces = (stack.enter_context(tempfile.TemporaryFile(dir=folder)) for _ in range(2))
                surfaces.setdefault(number, []).append(_Surface(name + level, meaning + level, points, faces))
            return surfaces[number]

        system = _collect(parts_of_meshes, surfaces_of)
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


def _collect(parts_of_meshes: Iterable[bytes], surfaces_of: Callable[[int], list[_Surface]]) -> str:
    """Add the faces of all parts to the surfaces of their level; return the CRS of the meshes."""
    system = ""
    open_vertices: dict[int, dict[Place, _OpenVertex]] = {}
    for data in parts_of_meshes:
        levels = defaultdict[int, Arrays](dict)
        with np.load(io.BytesIO(data), allow_pickle=False) as npz:
            own_system = str(npz["crs"])
            for level, _, name in (full.partition(".") for full in npz.files if full != "crs"):
                levels[int(level)][name] = npz[f"{level}.{name}"]
        system = system or own_system
        if own_system != system:
            raise TaskError(
                f"meshes in {crs.short(system)} and {crs.short(own_system)} do not fit in one LandXML file;"
                " export each CRS to a file of its own"
            )
        for number, own in levels.items():
            _add(own, surfaces_of(number), open_vertices.setdefault(number, {}))
    if not any(surface.faces for surface in surfaces_of(0)):
        raise TaskError("no tile has a mesh with a face; choose an area with tiles that succeeded")
    return system


def _add(own: Arrays, surfaces: Sequence[_Surface], open_vertices: dict[Place, _OpenVertex]) -> None:
    """Add the faces of a part of one level to its surfaces."""
    at_rim = list[_OpenVertex]()
    for (x, y, z), angle in zip(own["places"].tolist(), own["angles"].tolist(), strict=True):
        vertex = open_vertices.setdefault((x, y, z), _OpenVertex((x, y, z)))
        vertex.angle += angle
        at_rim.append(vertex)
    for number, surface in enumerate(surfaces):
        surface.add(own, number, at_rim)
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
    """Its numbers in the surfaces of road and ground; 0 if it is not in the surface."""


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

    def add(self, part: Arrays, number: int, at_rim: Sequence[_OpenVertex]) -> None:
        """Write the faces of a part, and their points that no earlier part has written.

        - `number`: 0 for the road, 1 for the ground.
        """
        corners = part[f"corners{number}"]
        if not len(corners):
            return
        lines = part[f"points{number}"].tobytes().splitlines()
        ids = np.zeros(len(lines), np.int64)
        rim = [(point, at_rim[row]) for point, row in part[f"rim{number}"].tolist()]
        for point, vertex in rim:
            ids[point] = vertex.numbers[number]
        new = np.flatnonzero(ids == 0)
        ids[new] = self.points + 1 + np.arange(len(new))
        for point, vertex in rim:
            vertex.numbers[number] = int(ids[point])
        _write_rows(self.points_file, POINT_START, [ids[new].tolist(), [lines[k] for k in new.tolist()]])
        _write_rows(self.faces_file, FACE, ids[corners].T.tolist())
        self.points += len(new)
        self.faces += len(corners)
        low, high = part[f"limits{number}"].tolist()
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
    """Write columns of values, all rows in the same format."""
    file.write(b"".join(map(row.__mod__, zip(*columns, strict=True))))


def _copy(source: IO[bytes], target: IO[bytes]) -> None:
    source.seek(0)
    shutil.copyfileobj(source, target, 1 << 20)


def _coordinate_system(plan: str, vertical: str | None) -> str:
    """Return the attributes of CoordinateSystem: EPSG code, or WKT if there is no code."""
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
