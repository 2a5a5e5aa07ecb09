"""OpenDRIVE as CARLA and SUMO read it: places on lanes, with the heights of the elevation profile alone."""

import csv
import json
import re
import subprocess
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
from pyproj import CRS, Transformer

from tests import validators

SCRIPT = Path(__file__).with_name("read_carla.py")
SAME_ELLIPSOID = ("GRS 1980", "WGS 84")
"""Ellipsoids whose geographic CRS the file keeps; else it has WGS 84."""


def by_carla(file: Path, step_m: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """Return road and place (x, y, height) of points along all lanes, ``(n,)`` and ``(n, 3)``."""
    command = [validators.python(), SCRIPT, file, str(step_m)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    found = np.array(json.loads(done.stdout))
    return found[:, 0].astype(int), found[:, 1:]


def by_sumo(file: Path, folder: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return the same of the vertices of SUMO's lanes, by netconvert, which writes into a folder."""
    net = folder / "roads.net.xml"
    command = [validators.program("netconvert"), "--opendrive-files", file, "--precision", "4", "-o", net]
    subprocess.run(command, capture_output=True, check=True)
    root = ElementTree.parse(net).getroot()
    offset = [float(number) for number in root.find("location").attrib["netOffset"].split(",")]
    roads, places = [], []
    for edge in root.findall("edge"):
        if edge.get("function") == "internal":
            continue
        road = int(re.fullmatch(r"-?(\d+).*", edge.attrib["id"])[1])
        for lane in edge.findall("lane"):
            shape = [[float(number) for number in point.split(",")] for point in lane.attrib["shape"].split()]
            roads += [road] * len(shape)
            places += shape
    return np.array(roads), np.array(places) - [*offset, 0.0]


def in_crs(file: Path, crs: str, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return eastings and northings of places of the file in the CRS of its run."""
    reference = ElementTree.parse(file).getroot().findtext("header/geoReference")
    geographic = CRS(crs).geodetic_crs
    if geographic.ellipsoid.name not in SAME_ELLIPSOID:
        geographic = CRS("EPSG:4326")
    to_degrees = Transformer.from_pipeline(
        f"+proj=pipeline +step +inv {reference} +step +proj=unitconvert +xy_in=rad +xy_out=deg"
    )
    return Transformer.from_crs(geographic, crs, always_xy=True).transform(*to_degrees.transform(x, y))


def printed_mm(report: Path, *columns: str) -> dict[int, float]:
    """Return the sum of columns of ``roads.csv`` for each road."""
    with report.open() as file:
        return {int(row["id"]): sum(float(row[name]) for name in columns) for row in csv.DictReader(file)}
