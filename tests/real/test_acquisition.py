"""docs/results/real_data.md: its commands give its tables, and independent heights agree.

Roads along centre lines are exported from the same scan.
"""

import csv
import re
import shlex
import shutil
import zipfile
from pathlib import Path

import laspy
import numpy as np
import pandas as pd
import pytest
import rasterio
from scipy.ndimage import map_coordinates

from flexroad.pipeline.run.sampler import RunSampler
from tests.read_opendrive import quality_issues
from tests.real.opendrive import reference_lines
from tests.real.shown import flexroad, measured, table_after

PAGE = (Path(__file__).parents[2] / "docs" / "results" / "real_data.md").read_text()
SETS = ("barbican", "gothenburg", "autzen", "ign", "stbarth", "brighton", "deepscenario")
ROADS = Path(__file__).parent / "roads"
FOOT = 0.3048
ORIGIN = (552_208.0, 4_114_742.0)
"""Easting and northing of the DeepScenario crop's local origin (m)."""
pytestmark = [pytest.mark.real, pytest.mark.slow]


@pytest.fixture(scope="module")
def folder(real_data, tmp_path_factory) -> Path:
    """Folder in which the page's commands have run."""
    path = tmp_path_factory.mktemp("acquisition")
    for name in ("autzen", "ign_crops", "brighton_beach", "deepscenario"):
        (path / name).symlink_to(real_data / name)
    (path / "roads").symlink_to(ROADS)
    for archive in ("London_BNG", "Goteborg_SWEREF99_1200"):
        zipfile.ZipFile(real_data / "umep" / f"{archive}.zip").extractall(path / "umep")
    for name in SETS:
        for line in commands(name):
            flexroad(shlex.split(line)[1:], path)
    return path


def commands(name: str) -> list[str]:
    lines = re.findall(rf"^flexroad .*[ /]{name}(?:\.parquet)?$", PAGE, flags=re.MULTILINE)
    assert len(lines) == 2
    return lines


def heights(path: Path, easting, northing):
    with rasterio.open(path) as raster:
        col = (easting - raster.bounds.left) / raster.res[0] - 0.5
        row = (raster.bounds.top - northing) / raster.res[1] - 0.5
        return map_coordinates(raster.read(1), [row, col], order=1, cval=np.nan)


def spread(differences):
    """Median, NMAD and p95 (m), and the number of finite values."""
    finite = differences[np.isfinite(differences)]
    median = np.median(finite)
    nmad = 1.4826 * np.median(abs(finite - median))
    return median, nmad, np.percentile(abs(finite), 95), len(finite)


def page_values(pattern: str) -> list[float]:
    """The numbers that a regular expression matches on the page."""
    return [float(value.replace(",", "")) for value in re.search(pattern, PAGE).groups()]


FIGURES = r"median \+?([-\d.]+) m, NMAD ([\d.]+) m, p95 ([\d.]+) m"


@pytest.mark.parametrize("name", SETS)
def test_commands_give_table_of_page(folder, name):
    shown = table_after(PAGE, commands(name)[1])
    assert [row[0] for row in shown] == ["plane", "rgt", "flexroad"]
    for (method, expected), (_, actual) in zip(shown, measured(f"runs/{name}", folder), strict=True):
        assert actual == pytest.approx(expected, abs=0.0015, rel=1e-3), method


def test_autzen_ground_agrees_with_other_classification(folder):
    cloud = laspy.read(folder / "autzen" / "autzen-thin.las")
    ground = np.asarray(cloud.classification) == 2
    x, y, z = (np.asarray(axis)[ground] * FOOT for axis in (cloud.x, cloud.y, cloud.z))
    points, *expected = page_values(r"against ([\d,]+) ground points[^.]*:\s*" + FIGURES)
    *actual, count = spread(heights(folder / "data/autzen/dtm.tif", x, y) - z)
    assert count == points
    assert actual == pytest.approx(expected, abs=0.001)


def test_ign_ground_agrees_with_dtm_of_ign(folder):
    reference = folder / "ign_crops/l93_770500_6277500/DTM/test_data_77055_627760_LA93_IGN69_50CM.tif"
    with rasterio.open(reference) as raster:
        dtm = raster.read(1, masked=True).filled(np.nan)
        row, col = np.mgrid[: raster.height, : raster.width]
        x, y = raster.transform @ (col.ravel() + 0.5, row.ravel() + 0.5)
    cells, *expected = page_values(r"of it, ([\d,]+) cells\): " + FIGURES)
    *actual, count = spread(heights(folder / "data/ign/dtm.tif", x, y) - dtm.ravel())
    assert count == cells
    assert actual == pytest.approx(expected, abs=0.001)


@pytest.mark.parametrize("source", ["OpenDRIVE", "vehicles"])
def test_deepscenario_roads_agree_with_map_and_vehicles(folder, source):
    scenario = folder / "deepscenario"
    if source == "OpenDRIVE":
        points = np.vstack(reference_lines(scenario / "map" / "map.xodr"))
    else:
        # The position of a vehicle is the centre of its base.
        tracks = pd.read_parquet(next(scenario.glob("annotations/*/annotations.parquet")))
        points = tracks[["translation_x", "translation_y", "translation_z"]].to_numpy()
    x, y, z = points.T
    x, y = x + ORIGIN[0], y + ORIGIN[1]
    covered = np.isfinite(heights(folder / "data/deepscenario/dsm.tif", x, y))
    count, *shown = page_values(
        rf"\| [^|]*{source}[^|]*" + r"\| ([\d,]+) \| ([\d.]+) \| ([\d.]+) \| ([\d.]+)"
    )
    assert covered.sum() == count
    for variant, expected in zip(("plane", "rgt", "flexroad"), shown, strict=True):
        surface = RunSampler.open(folder / "runs/deepscenario", variant).at(x[covered], y[covered])
        assert abs(surface.height - z[covered]).mean() == pytest.approx(expected, abs=0.001)


@pytest.fixture(scope="module")
def along_roads(folder) -> tuple[list[str], list[str]]:
    """Lines that the commands of the page print on Autzen, and those that the page shows."""
    (block,) = re.findall(r"```console\n(\$ flexroad run [^`]*runs/autzen_roads[^`]*)```", PAGE)
    lines = block.splitlines()
    for command in (line[2:] for line in lines if line[0] == "$"):
        said = flexroad(shlex.split(command)[1:], folder)
    printed = [line for line in said.splitlines() if line.startswith(("crg", "xodr", "lines", "  "))]
    return printed, [line for line in lines if line[0] != "$"]


def test_export_along_roads_prints_the_lines_of_the_page(along_roads):
    printed, shown = along_roads
    assert printed == shown


def test_errors_of_opencrg_are_those_of_the_page(folder, along_roads):
    with (folder / "delivery" / "crg" / "roads.csv").open() as file:
        rows = list(csv.DictReader(file))
    largest = np.array([float(row["crg_max_mm"]) for row in rows])
    medians = [float(row["crg_median_mm"]) for row in rows]
    assert ((largest > 2).sum(), len(rows)) == (1, 36)
    assert (round(min(medians), 2), round(max(medians), 2)) == (0.02, 0.16)


def test_opendrive_has_no_issue(folder, along_roads, tmp_path):
    file = shutil.copy(next((folder / "delivery" / "xodr").glob("*.xodr")), tmp_path / "roads.xodr")
    assert quality_issues(file) == []
