"""Point clouds for tests."""

from pathlib import Path

import laspy
import numpy as np
from pyproj import CRS


def write_cloud(path: Path, xyz, kind=1, crs=None, colour=None, withheld=None, scale=0.01) -> Path:
    """Write a LAS or LAZ file of points ``(n, 3)``; one class for all or per point; colours ``(n, 3)``."""
    xyz = np.asarray(xyz, np.float64).reshape(-1, 3)
    header = laspy.LasHeader(point_format=6 if colour is None else 7, version="1.4")
    header.scales = [scale] * 3
    header.offsets = np.floor(xyz.min(axis=0)) if len(xyz) else [0, 0, 0]
    if crs:
        header.add_crs(CRS.from_user_input(crs))
    points = laspy.LasData(header)
    points.x, points.y, points.z = xyz.T
    points.classification = np.broadcast_to(np.asarray(kind, np.uint8), len(xyz))
    if colour is not None:
        points.red, points.green, points.blue = np.asarray(colour, np.uint16).T
    if withheld is not None:
        points.withheld = withheld
    path.parent.mkdir(parents=True, exist_ok=True)
    points.write(path)
    return path
