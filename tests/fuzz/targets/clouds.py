"""Point clouds: their headers and their points, by `flexroad prepare`."""

from pathlib import Path

import laspy
import numpy as np

from flexroad.catalog.scan.point_clouds import chunks, inspect
from tests.make_clouds import write_cloud

POINTS = 3000


def make(folder: Path) -> list[Path]:
    rng = np.random.default_rng(0)
    xyz = rng.random((POINTS, 3)) * (100, 100, 5) + (500_000, 5_600_000, 90)
    kinds = rng.choice((2, 3, 7), POINTS)
    colour = rng.integers(0, 65536, (POINTS, 3))
    made = [
        write_cloud(folder / "plain.las", xyz, kinds, "EPSG:25832"),
        write_cloud(folder / "packed.laz", xyz, kinds, "EPSG:25832"),
        write_cloud(folder / "colour.laz", xyz, kinds, colour=colour),
        folder / "old.laz",
    ]
    header = laspy.LasHeader(point_format=1, version="1.2")
    header.scales, header.offsets = [0.01] * 3, [500_000, 5_600_000, 0]
    points = laspy.LasData(header)
    points.x, points.y, points.z = xyz.T
    points.classification = kinds
    points.write(made[-1])
    return made


def read(path: Path) -> None:
    inspect(path)
    for _ in chunks(path):
        pass
