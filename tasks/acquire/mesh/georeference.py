"""Where in the world a mesh lies: the CRS and the offset that its own coordinates lack."""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from flexroad.catalog.crs import in_plan
from flexroad.catalog.errors import CatalogError
from flexroad.tasks.errors import TaskError
from flexroad.tasks.types import Floats

Offset = tuple[float, float, float]
"""Easting, northing and height of the mesh's zero, in units of its CRS."""

LOCAL = 10_000.0
"""Coordinates below this in both directions are no place in any usual CRS, but relative to something."""
FOLDERS = 3
"""A mesh's own folder and so many less one above it are searched for a sidecar."""


@dataclass(frozen=True)
class Placement:
    """What is known of where a mesh lies."""

    crs: str | None = None
    offset: Offset | None = None

    def over(self, other: Placement) -> Placement:
        """Return what this one says and, where it is silent, the other."""
        return Placement(
            other.crs if self.crs is None else self.crs, other.offset if self.offset is None else self.offset
        )

    def apply(self, path: Path, vertices: Floats) -> tuple[str, Floats]:
        """Return the CRS and the vertices in it, ``(V, 3)``.

        Raises
        ------
        TaskError
            If the CRS is not known or is none, or the vertices are local and no offset is known.
        """
        local = self.offset is None and bool(np.nanmax(np.abs(vertices[:, :2])) < LOCAL)
        if self.crs is None or local:
            lacks = "in which CRS it is" if not local else "where it lies"
            raise TaskError(
                f"{path} does not say {lacks}, and neither data_meta.json, coords.txt nor .prj beside it or "
                "up to two folders above does; give --crs EPSG:... and --offset EASTING,NORTHING,HEIGHT",
                file=str(path),
            )
        try:
            return in_plan(self.crs) and self.crs, vertices + (self.offset or (0.0, 0.0, 0.0))
        except CatalogError as error:
            raise TaskError(f"{path}: {error}", file=str(path)) from error


def beside(path: Path) -> Placement:
    """Read the nearest sidecar of a mesh, in its folder or up to two above; empty if there is none.

    Known are ``data_meta.json`` (DeepScenario: UTM zone and offset), ``coords.txt``, also in
    ``odm_georeferencing`` (OpenDroneMap: UTM zone, then an offset in plan; heights are true), and a ``.prj``
    (the CRS alone).

    Raises
    ------
    TaskError
        If a sidecar is not what its name says; the line names it.
    """
    found = Placement()
    for folder in path.resolve().parents[:FOLDERS]:
        for name, read in (
            ("data_meta.json", _deepscenario),
            ("coords.txt", _odm),
            ("odm_georeferencing/coords.txt", _odm),
        ):
            if (folder / name).is_file():
                return found.over(read(folder / name))
        found = found.over(_prj(folder, path.stem))
    return found


def _deepscenario(path: Path) -> Placement:
    try:
        reference = json.loads(path.read_text(encoding="utf-8"))["reference_utm"]
        (zone, half), (east, north, up) = reference["zone"], map(float, reference["offset"])
        return Placement(_utm(int(zone), str(half)), (east, north, up))
    except (KeyError, TypeError, ValueError) as error:
        raise TaskError(
            f'{path} has no reference_utm with a zone like [17, "N"] and an offset of three numbers: '
            f"{error}; give --crs and --offset",
            file=str(path),
        ) from error


def _odm(path: Path) -> Placement:
    head, _, rest = path.read_text(encoding="utf-8", errors="replace").strip().partition("\n")
    zone = re.fullmatch(r"WGS84 UTM (\d{1,2})\s?([NS])", head.strip(), re.IGNORECASE)
    try:
        east, north, *_ = (float(number) for number in rest.partition("\n")[0].split())
    except ValueError as error:
        raise TaskError(
            f"{path} has no CRS in its first line and an offset in its second; give --crs and --offset",
            file=str(path),
        ) from error
    return Placement(_utm(int(zone[1]), zone[2]) if zone else head.strip(), (east, north, 0.0))


def _prj(folder: Path, stem: str) -> Placement:
    own = folder / f"{stem}.prj"
    files = [own] if own.is_file() else sorted(folder.glob("*.prj"))
    if len(files) != 1:
        return Placement()
    return Placement(files[0].read_text(encoding="utf-8", errors="replace").strip())


def _utm(zone: int, half: str) -> str:
    if not (1 <= zone <= 60 and half.upper() in ("N", "S")):
        raise ValueError(f"there is no UTM zone {zone}{half}")
    return f"EPSG:{(32600 if half.upper() == 'N' else 32700) + zone}"
