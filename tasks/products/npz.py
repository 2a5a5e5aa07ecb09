"""The fitted surface (the paper's parameters Theta) as NumPy archive, usable without the run.

NumPy reads it. `decode` returns the `NurbsSurface`; `tasks.spline.surface.exact` converts the surface to the
form that CAD programs read.
"""

from __future__ import annotations

import io
import zipfile
import zlib
from collections.abc import Iterator
from dataclasses import astuple
from pathlib import Path

import numpy as np
import shapely
from numpy.typing import NDArray

from flexroad.catalog.grid import Grid
from flexroad.tasks.errors import TaskError
from flexroad.tasks.io.archive import npz
from flexroad.tasks.spline.levelled import LevelledSurface
from flexroad.tasks.spline.stepped import SteppedSurface
from flexroad.tasks.spline.surface import NurbsSurface
from flexroad.tasks.types import Level, LevelSpline

VERSION = 2
WITH_LEVELS = 3
"""Version of files with several levels."""
NAME = "_surface.npz"
STEPS = ("steps", "south_north", "west_east")
SHAPES = ("areas", "abutments", "approach", "passing")
"""Fields of a `Level` that are written."""
MEDIA_TYPE = "application/zip"

DAMAGED = (OSError, ValueError, KeyError, TypeError, AttributeError, EOFError, zipfile.BadZipFile, zlib.error)
"""Exceptions raised by reading a file that is truncated, changed, or of another format."""


def encode(surface: NurbsSurface) -> bytes:
    """Return a surface as ``.npz``: one array per field of `NurbsSurface`, and ``version``.

    A `SteppedSurface` has four more: ``steps``, ``south_north`` and ``west_east`` (float32), and ``cells``,
    their grid (west, north and cell size in m, columns, rows).

    A `LevelledSurface`, version 3, has ``levels``, the numbers of its other levels. Each of them, such as
    level 1, has ``A_1`` (its coefficients) and the shapes of its `Level` as WKB (m): ``areas_1``,
    ``abutments_1``, ``approach_1`` and ``passing_1``.

    ``z(u, v) = datum + A(u, v) / W(u, v)``, with u and v affine over ``bounds`` (west, south, east, north;
    m), from the knot with the number ``degree`` to the knot with the same distance from the end. Coefficients
    are (row, col) with row 0 in the south. No pickled objects; float64.
    """
    stepped: dict[str, NDArray[np.generic]] = {}
    if isinstance(surface, SteppedSurface):
        _, *numbers = astuple(surface.cells)
        stepped = {name: getattr(surface, name) for name in STEPS}
        stepped["cells"] = np.asarray(numbers, np.float64)
    version = VERSION
    if surface.levels:
        version = WITH_LEVELS
        stepped["levels"] = np.array([own.level.number for own in surface.levels], np.int64)
        for own in surface.levels:
            stepped[f"A_{own.level.number}"] = own.A
            for name in SHAPES:
                wkb = shapely.to_wkb(getattr(own.level, name))
                stepped[f"{name}_{own.level.number}"] = np.frombuffer(wkb, np.uint8)
    return npz(
        {
            "version": np.int64(version),
            "crs": np.array(surface.crs),
            "bounds": np.asarray(surface.bounds, np.float64),
            "degree": np.asarray(surface.degree, np.int64),
            "knots_u": surface.knots_u,
            "knots_v": surface.knots_v,
            "A": surface.A,
            "W": surface.W,
            "datum": np.float64(surface.datum),
            "origin": np.asarray(surface.origin, np.float64),
            **stepped,
        }
    )


def decode(source: bytes | Path | str) -> NurbsSurface:
    """Return the surface written by `encode`, from its bytes or its file.

    Raises
    ------
    TaskError
        If the file is missing, damaged, not a surface, or of a newer version.
    """
    name = "these bytes" if isinstance(source, bytes) else str(source)
    try:
        with np.load(
            io.BytesIO(source) if isinstance(source, bytes) else source, allow_pickle=False
        ) as archive:
            arrays = {key: archive[key] for key in archive.files}
        version = int(arrays["version"])
        if version > WITH_LEVELS:
            message = (
                f"{name}: surface of version {version}, this program reads up to {WITH_LEVELS}; "
                "update FlexRoad"
            )
            raise TaskError(message, name)
        return _surface(arrays)
    except DAMAGED as error:
        raise TaskError(f"{name}: not a FlexRoad surface ({error}); export it again", name) from error


def _surface(arrays: dict[str, np.ndarray]) -> NurbsSurface:
    west, south, east, north = map(float, arrays["bounds"])
    p, q = map(int, arrays["degree"])
    easting, northing = map(float, arrays["origin"])
    knots_u, knots_v, a, w = (arrays[key] for key in ("knots_u", "knots_v", "A", "W"))
    expected = len(knots_v) - q - 1, len(knots_u) - p - 1
    if not a.shape == w.shape == expected:
        raise ValueError(f"coefficients {a.shape} and weights {w.shape} do not fit knots for {expected}")
    spline = NurbsSurface(
        crs=str(arrays["crs"]),
        bounds=(west, south, east, north),
        degree=(p, q),
        knots_u=knots_u,
        knots_v=knots_v,
        A=a,
        W=w,
        datum=float(arrays["datum"]),
        origin=(easting, northing),
    )
    if "steps" not in arrays:
        return spline
    west, north, cell, width, height = map(float, arrays["cells"])
    cells = Grid(spline.crs, west, north, cell, int(width), int(height))
    steps, south_north, west_east = (arrays[name] for name in STEPS)
    shapes = steps.shape, south_north.shape, west_east.shape
    rows, columns = (max(len(borders), 2) for borders in (south_north, west_east))
    if shapes != (cells.shape, (rows, cells.width), (columns, cells.height)):
        raise ValueError(f"steps {shapes} do not fit cells {cells.shape}")
    stepped = SteppedSurface(
        **vars(spline), steps=steps, cells=cells, south_north=south_north, west_east=west_east
    )
    if "levels" not in arrays:
        return stepped
    return LevelledSurface(**vars(stepped), levels=tuple(_levels(arrays, expected)))


def _levels(arrays: dict[str, np.ndarray], expected: tuple[int, int]) -> Iterator[LevelSpline]:
    for number in arrays["levels"].tolist():
        control = arrays[f"A_{number}"]
        if control.shape != expected:
            raise ValueError(f"coefficients {control.shape} of level {number} are not {expected}")
        shapes = {name: shapely.from_wkb(arrays[f"{name}_{number}"].tobytes()) for name in SHAPES}
        yield LevelSpline(Level(int(number), **shapes), control)
