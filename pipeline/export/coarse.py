"""Coarse meshes of 3D Tiles, made level by level: each from small records of the tiles or meshes below it.

A record is a `Relief` with its image, in a file of the folder ``.coarse``. A worker reads those of one area,
so that memory does not depend on the size of a run, and an interrupted export goes on.
"""

from __future__ import annotations

import io
import zipfile
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from hashlib import sha256
from typing import Any

import numpy as np

from flexroad.catalog.ellipsoidal import Datum, Ellipsoidal
from flexroad.catalog.storage.paths import Location, parse_location, read
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.export.pieces import Piece, Row
from flexroad.tasks.export import glb, tiles3d
from flexroad.tasks.meshing import aerial, relief
from flexroad.tasks.meshing.aerial import Aerial
from flexroad.tasks.meshing.relief import Relief

RECORDS, MESHES = ".coarse", "coarse"
"""Folders of records, and of GLB files."""
PREFIX = "coarse_"
"""Start of the ids of coarse meshes, which keeps them apart from those of tiles."""
QUALITY = 85
"""Quality of JPEG images."""
SHARP = 8
"""Geometric error of a mesh in pixels of its image, at least: programs show errors of up to 16 pixels of the
screen (the default of CesiumJS), so that a pixel of the image covers at most two of the screen."""
DAMAGED = (ValueError, KeyError, EOFError, zipfile.BadZipFile, zlib.error)


@dataclass(frozen=True)
class Level:
    """How coarse meshes of one size are."""

    side_m: float
    """Side of their areas (m)."""
    spacing_m: float
    """Distance of vertices (m)."""
    pixel_m: float
    """Size of pixels of the image (m)."""


TILE = Level(0.0, 4.0, 2.0)
"""Records of tiles; they are shown only as parts of coarser ones."""
LEVELS = (Level(1000.0, 16.0, 2.0), Level(2000.0, 32.0, 4.0), Level(4000.0, 64.0, 8.0))
"""From fine to coarse; each side is twice the one before."""


@dataclass(frozen=True)
class Place:
    """What the place of a tile's mesh is computed of."""

    run: str
    crs: str
    origin: tuple[float, float]
    datum: Datum

    @property
    def conversion(self) -> Ellipsoidal:
        """From the CRS and the heights of the run to WGS 84."""
        return Ellipsoidal(self.crs, self.datum)


@dataclass(frozen=True)
class Branch:
    """A coarse mesh to be written; sent to a worker."""

    id: str
    level: Level
    cell: tuple[int, int]
    """Column and row of its area, in sides of the finest level."""
    parts: tuple[Row, ...]
    """Rows of the tiles or coarse meshes that it replaces from afar."""
    folder: str

    @property
    def label(self) -> str:
        """Its name in messages."""
        return f"area {self.id.removeprefix(PREFIX)}"

    @property
    def fingerprint(self) -> str:
        """Name of the mesh by what it is made of."""
        made_of = [(row["record"], row["digest"], row["error_m"]) for row in self.parts]
        return sha256(f"{self.level} {made_of}".encode()).hexdigest()


def record(name: str, ground: Relief, image: Aerial) -> tuple[dict[str, bytes], Row]:
    """Return a record as file, and the part of a row that refers to it."""
    arrays: Mapping[str, Any] = {
        "bounds": np.array(ground.bounds),
        "heights": ground.heights,
        "cells": ground.cells,
        "error_m": np.float64(ground.error_m),
        "colour": np.rint(image.colour).astype(np.uint8),
        "share": np.rint(image.share * 255).astype(np.uint8),
    }
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)
    data, path = buffer.getvalue(), f"{RECORDS}/{name}.npz"
    return {path: data}, {"record": path, "digest": sha256(data).hexdigest()}


def branch_piece(branch: Branch, place: Place) -> Piece:
    """Return the GLB file of a coarse mesh, its record, and its row."""
    folder, level = parse_location(branch.folder), branch.level
    parts = [_read(folder, row) for row in branch.parts]
    ground = relief.joined([part for part, _ in parts], level.spacing_m)
    image = aerial.joined([part for _, part in parts], ground.bounds, level.pixel_m)
    # Neighbours of the same level differ by less than twice the error.
    sheet = relief.sheet(ground, max(2 * ground.error_m, level.pixel_m))
    uri = f"{MESHES}/{branch.id.removeprefix(PREFIX)}{glb.NAME}"
    placed, local = tiles3d.sheet_placed(uri, sheet.points, place.conversion)
    data = glb.encode_sheet(sheet, local, image.bounds, glb.jpeg(image.complete(), QUALITY))
    error_m = max(ground.error_m, SHARP * level.pixel_m, *(row["error_m"] for row in branch.parts))
    files, referred = record(branch.id, ground, image)
    row = row_of(branch.id, branch.cell, placed, error_m) | {"vertical_m": ground.error_m}
    return Piece({uri: data, **files}, row | referred)


def row_of(name: str, cell: tuple[int, int], placed: tiles3d.Placed, error_m: float) -> Row:
    """Return the row of a tile or coarse mesh, without its record."""
    return {
        "id": name,
        "cell": cell,
        "uri": placed.uri,
        "transform": placed.transform,
        "region": placed.region,
        "error_m": error_m,
    }


def _read(folder: Location, row: Row) -> tuple[Relief, Aerial]:
    data = read(folder / row["record"])
    try:
        if sha256(data).hexdigest() != row["digest"]:
            raise ValueError("its checksum differs")
        with np.load(io.BytesIO(data), allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
        west, south, east, north = arrays["bounds"].tolist()
        bounds = west, south, east, north
        ground = Relief(bounds, arrays["heights"], arrays["cells"], float(arrays["error_m"]))
        return ground, Aerial(bounds, arrays["colour"].astype(np.float64), arrays["share"] / 255)
    except DAMAGED as error:
        raise ConfigError(
            f"{folder / row['record']} is damaged ({error}); remove it and export again"
        ) from error
