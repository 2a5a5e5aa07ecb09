"""Georeference of a mesh: the CRS and the offset of its local coordinates."""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from pathlib import Path
from xml.sax.saxutils import unescape

import numpy as np

from flexroad.catalog.crs import in_plan
from flexroad.catalog.errors import CatalogError
from flexroad.catalog.grid import FARTHEST
from flexroad.tasks.errors import TaskError
from flexroad.tasks.types import Floats

Offset = tuple[float, float, float]
"""Easting, northing and height of the mesh's origin, in units of its CRS."""

LOCAL_BELOW = 10_000.0
"""If all plan coordinates are smaller than this, they are local, not in a CRS."""
MOST_CHARACTERS = 2**20
"""Longest sidecar file that is read."""
SRS = re.compile(r"<SRS>\s*([^<]+?)\s*</SRS>")
SRS_ORIGIN = re.compile(r"<SRSOrigin>\s*([^<]+?)\s*</SRSOrigin>")
SEARCHED_FOLDERS = 3
"""Number of folders searched for a sidecar file: the mesh's own and those above it."""


@dataclass(frozen=True)
class Georeference:
    """CRS and offset of a mesh; None where unknown."""

    crs: str | None = None
    offset: Offset | None = None

    def with_fallback(self, other: Georeference) -> Georeference:
        """Return a copy with missing values taken from another georeference."""
        return Georeference(
            other.crs if self.crs is None else self.crs, other.offset if self.offset is None else self.offset
        )

    def apply(self, path: Path, vertices: Floats) -> tuple[str, Floats]:
        """Return the CRS and the vertices with the offset added, ``(V, 3)``."""
        if self.offset is not None and not all(abs(axis) <= FARTHEST for axis in self.offset):
            raise TaskError(
                f"{path} has the offset {self.offset}, which is not a place; give --offset EASTING NORTHING "
                "HEIGHT",
                file=str(path),
            )
        local = self.offset is None and bool(np.nanmax(np.abs(vertices[:, :2])) < LOCAL_BELOW)
        if self.crs is None or local:
            missing = "georeference" if local else "CRS"
            raise TaskError(
                f"{path} has no {missing}, and no data_meta.json, coords.txt, metadata.xml or .prj in its "
                "folder or up to two above has one; give --crs EPSG:... and --offset EASTING NORTHING HEIGHT",
                file=str(path),
            )
        try:
            return in_plan(self.crs) and self.crs, vertices + (self.offset or (0.0, 0.0, 0.0))
        except CatalogError as error:
            raise TaskError(f"{path}: {error}", file=str(path)) from error


def read_sidecar(path: Path) -> Georeference:
    """Read the nearest sidecar file of a mesh, in its folder or up to two above; empty if not found.

    Supported are ``data_meta.json`` (DeepScenario: UTM zone and offset), ``metadata.xml`` (ContextCapture,
    DJI Terra and others: ``SRS`` and ``SRSOrigin``), and ``.prj`` (only the CRS). ``coords.txt``, also in
    ``odm_georeferencing``, is from OpenDroneMap: UTM zone, and an offset in plan but not in height.
    """
    result = Georeference()
    for folder in path.resolve().parents[:SEARCHED_FOLDERS]:
        for name, read in (
            ("data_meta.json", _deepscenario),
            ("coords.txt", _odm),
            ("odm_georeferencing/coords.txt", _odm),
            ("metadata.xml", _model_metadata),
        ):
            if (folder / name).is_file():
                return result.with_fallback(read(folder / name))
        result = result.with_fallback(_prj(folder, path.stem))
    return result


def _deepscenario(path: Path) -> Georeference:
    try:
        reference = json.loads(_text(path))["reference_utm"]
        (zone, half), (east, north, up) = reference["zone"], map(float, reference["offset"])
        return Georeference(_utm(int(zone), str(half)), (east, north, up))
    except (KeyError, TypeError, ValueError, OverflowError, RecursionError) as error:
        raise TaskError(
            f'{path} has no reference_utm with a zone like [17, "N"] and an offset of three numbers: '
            f"{error}; give --crs and --offset",
            file=str(path),
        ) from error


def _odm(path: Path) -> Georeference:
    head, _, rest = _text(path).strip().partition("\n")
    zone = re.fullmatch(r"WGS84 UTM (\d{1,2})\s?([NS])", head.strip(), re.IGNORECASE)
    try:
        east, north, *_ = (float(number) for number in rest.partition("\n")[0].split())
    except ValueError as error:
        raise TaskError(
            f"{path} has no CRS in its first line and an offset in its second; give --crs and --offset",
            file=str(path),
        ) from error
    return Georeference(_utm(int(zone[1]), zone[2]) if zone else head.strip(), (east, north, 0.0))


def _model_metadata(path: Path) -> Georeference:
    text = _text(path)
    crs, origin = SRS.search(text), SRS_ORIGIN.search(text)
    try:
        if crs is None:
            raise ValueError("there is no SRS")
        system = unescape(crs[1])
        in_plan(system)
        east, north, up = map(float, (origin[1] if origin else "0,0,0").split(","))
    except (ValueError, CatalogError) as error:
        raise TaskError(
            f"{path} has no SRS like EPSG:32632 with an SRSOrigin of three numbers: {error}; give --crs and "
            "--offset",
            file=str(path),
        ) from error
    return Georeference(system, (east, north, up))


def _text(path: Path) -> str:
    with path.open(encoding="utf-8", errors="replace") as file:
        return file.read(MOST_CHARACTERS)


def _prj(folder: Path, stem: str) -> Georeference:
    own = folder / f"{stem}.prj"
    files = [own] if own.is_file() else sorted(file for file in folder.glob("*.prj") if file.is_file())
    if len(files) != 1:
        return Georeference()
    return Georeference(_text(files[0]).strip())


def _utm(zone: int, half: str) -> str:
    if not (1 <= zone <= 60 and half.upper() in ("N", "S")):
        raise ValueError(f"there is no UTM zone {zone}{half}")
    return f"EPSG:{(32600 if half.upper() == 'N' else 32700) + zone}"
