"""Reference lines of an OpenDRIVE map in 3-D: road heights that are independent of FlexRoad."""

import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

STEP_M = 0.1


def reference_lines(path: Path) -> list[NDArray[np.float64]]:
    """Points every `STEP_M` along each road's reference line, ``(n, 3)``: x, y, elevation (m).

    Curvature varies linearly along an element of the plan view (ASAM OpenDRIVE 1.7, chapter 9): it is 0 on a
    line and constant on an arc. Heading and position are its integrals, by the trapezoidal rule.
    """
    roads = ElementTree.parse(path).getroot().findall("road")
    return [np.vstack([_piece(piece, road) for piece in road.find("planView")]) for road in roads]


def _piece(piece, road):
    start, length = float(piece.get("s")), float(piece.get("length"))
    along = np.linspace(0, length, max(2, round(length / STEP_M)))
    begin, end = _curvature(piece[0])
    curvature = begin + (end - begin) * along / length
    heading = float(piece.get("hdg")) + _integral(curvature, along)
    x = float(piece.get("x")) + _integral(np.cos(heading), along)
    y = float(piece.get("y")) + _integral(np.sin(heading), along)
    return np.column_stack([x, y, _elevation(road, start + along)])


def _curvature(shape):
    if shape.tag == "line":
        return 0.0, 0.0
    if shape.tag == "arc":
        return (float(shape.get("curvature")),) * 2
    return float(shape.get("curvStart")), float(shape.get("curvEnd"))


def _integral(values, along):
    steps = np.diff(along) * (values[1:] + values[:-1]) / 2
    return np.concatenate([[0.0], np.cumsum(steps)])


def _elevation(road, s):
    rows = [[float(e.get(k)) for k in "sabcd"] for e in road.find("elevationProfile")]
    starts = np.array([row[0] for row in rows])
    a, b, c, d = np.array([row[1:] for row in rows])[np.searchsorted(starts, s + 1e-9) - 1].T
    t = s - starts[np.searchsorted(starts, s + 1e-9) - 1]
    return a + b * t + c * t**2 + d * t**3
