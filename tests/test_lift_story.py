"""The quick start of `flexroad lift`: an extract of OpenStreetMap, netconvert, heights, and three readers."""

import csv
import re
import shlex
import subprocess
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pyproj
import pytest

from flexroad.pipeline.run.sampler import RunSampler
from tests import make_osm, validators
from tests.command_line import call
from tests.read_opendrive import quality_issues
from tests.validators.opendrive import by_carla

ROOT = Path(__file__).parents[1]
EXTRACT = ROOT / "docs" / "examples" / "streets.osm"
MISSED_MM = 20
"""Rounding of SUMO's coordinates (0.01 m) on slopes, and of CARLA's float32 numbers."""


def test_the_extract_is_the_one_that_is_made(tmp_path):
    make_osm.write_extract(tmp_path / "streets.osm")
    assert (tmp_path / "streets.osm").read_text() == EXTRACT.read_text()


def commands() -> list[list[str]]:
    section = (ROOT / "docs" / "quickstart.md").read_text().partition("\n## Heights for your own roads")[2]
    lines = re.findall(r"^\$ (.*)$", section.partition("\n## ")[0], re.MULTILINE)
    return [shlex.split(line) for line in lines]


@pytest.fixture(scope="module")
def lifted(tmp_path_factory) -> Path:
    """Return a folder in which the commands of the page were run."""
    netconvert = validators.program("netconvert")
    folder = tmp_path_factory.mktemp("story")
    (folder / "docs").symlink_to(ROOT / "docs")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        for program, *words in commands():
            if program == "netconvert":
                subprocess.run([netconvert, *words], check=True, capture_output=True)
            else:
                call(*words, *(["--executor", "serial"] if words[0] == "run" else [])).expected(0)
    return folder


def offset(file: Path) -> np.ndarray:
    found = ElementTree.parse(file).getroot().find("header/offset")
    return np.array([float(found.attrib[axis]) for axis in "xyz"])


def surface(folder: Path, places: np.ndarray) -> np.ndarray:
    """Return the heights of the run at places in UTM, without kerbs."""
    to_run = pyproj.Transformer.from_crs("EPSG:32632", "EPSG:25832", always_xy=True)
    x, y = to_run.transform(*places[:, :2].T)
    return RunSampler.open(folder / "runs" / "town").heights(x, y, steps=False)[0].ground


def rows(folder: Path) -> dict[str, dict[str, str]]:
    with (folder / "lifted.csv").open() as file:
        return {row["id"]: row for row in csv.DictReader(file)}


@pytest.mark.slow
def test_carla_reads_heights_within_the_reported_error(lifted):
    file = lifted / "streets_3d.xodr"
    roads, places = by_carla(file)
    height = surface(lifted, places + offset(file))
    reported = rows(lifted)
    covered = np.array([reported[str(road)]["without_ground_m"] == "0.0" for road in roads])
    inside = covered & np.isfinite(height)
    assert inside.sum() > 2000
    missed = 1000 * np.abs(places[:, 2] - height)[inside]
    allowed = np.array([float(reported[str(road)]["elevation_max_mm"]) for road in roads[inside]])
    assert (missed - allowed).max() < MISSED_MM


@pytest.mark.slow
def test_asam_finds_nothing_that_it_does_not_find_in_the_flat_network(lifted):
    flat, high = (
        {(issue["description"].partition(" at ")[0]) for issue in quality_issues(lifted / name)}
        for name in ("streets.xodr", "streets_3d.xodr")
    )
    assert high <= flat


@pytest.mark.slow
def test_a_vehicle_of_sumo_drives_on_the_surface(lifted):
    net = lifted / "streets_3d.net.xml"
    edges = ElementTree.parse(net).getroot().findall("edge")
    ids = [edge.attrib["id"] for edge in edges if edge.get("function") != "internal"]
    trips = [
        f'<trip id="{number}" depart="{number}" from="{ids[number]}" to="{ids[-1 - number]}"/>'
        for number in range(0, len(ids), 7)
    ]
    (lifted / "trips.xml").write_text(f"<routes>{''.join(trips)}</routes>")
    positions = lifted / "fcd.xml"
    words = ["-n", net, "-r", lifted / "trips.xml", "--fcd-output", positions, "--fcd-output.geo", "false"]
    command = [validators.program("sumo"), *words, "--ignore-route-errors"]
    subprocess.run(command, check=True, capture_output=True)
    vehicles = ElementTree.parse(positions).getroot().iter("vehicle")
    places = np.array([[float(each.attrib[axis]) for axis in "xyz"] for each in vehicles])
    assert len(places) > 500
    net_offset = ElementTree.parse(net).getroot().find("location").attrib["netOffset"].split(",")
    height = surface(lifted, places - [*map(float, net_offset), 0.0])
    known = np.isfinite(height)
    assert known.mean() > 0.9
    assert np.abs(places[:, 2] - height)[known].max() < 0.1
