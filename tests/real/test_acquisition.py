"""docs/acquisition.md on real data: its commands give its tables, and heights from elsewhere agree."""

import re
import shlex
from pathlib import Path

import laspy
import numpy as np
import pandas as pd
import pytest
import rasterio
from scipy.ndimage import map_coordinates

from flexroad.pipeline.inspect.points import Ground
from tests.real.opendrive import reference_lines
from tests.real.shown import flexroad, measured, table_after

PAGE = (Path(__file__).parents[2] / "docs" / "acquisition.md").read_text()
SETS = ("autzen", "ign", "stbarth", "brighton", "deepscenario")
ROADS = Path(__file__).parent / "roads"
FOOT = 0.3048
ZERO = (552_208.0, 4_114_742.0)
"""The DeepScenario crop's zero: easting and northing."""
pytestmark = [pytest.mark.real, pytest.mark.slow]


@pytest.fixture(scope="module")
def folder(real_data, tmp_path_factory) -> Path:
    """Where the page's commands have been given."""
    here = tmp_path_factory.mktemp("acquisition")
    for name in ("autzen", "ign_crops", "brighton_beach", "deepscenario"):
        (here / name).symlink_to(real_data / name)
    (here / "roads").symlink_to(ROADS)
    for name in SETS:
        for line in commands(name):
            flexroad(shlex.split(line)[1:], here)
    return here


def commands(name: str) -> list[str]:
    found = re.findall(rf"^flexroad .*(?:data|runs)/{name}$", PAGE, flags=re.MULTILINE)
    assert len(found) == 2
    return found


def heights(path: Path, easting, northing):
    with rasterio.open(path) as raster:
        col = (easting - raster.bounds.left) / raster.res[0] - 0.5
        row = (raster.bounds.top - northing) / raster.res[1] - 0.5
        return map_coordinates(raster.read(1), [row, col], order=1, cval=np.nan)


def spread(differences):
    """Median, NMAD and p95 (m), and how many are known."""
    known = differences[np.isfinite(differences)]
    middle = np.median(known)
    nmad = 1.4826 * np.median(abs(known - middle))
    return middle, nmad, np.percentile(abs(known), 95), len(known)


def told(pattern: str) -> list[float]:
    """The figures of a sentence of the page."""
    return [float(figure.replace(",", "")) for figure in re.search(pattern, PAGE).groups()]


FIGURES = r"median \+?([-\d.]+) m, NMAD ([\d.]+) m, p95 ([\d.]+) m"


@pytest.mark.parametrize("name", SETS)
def test_commands_give_the_table(folder, name):
    shown = table_after(PAGE, commands(name)[1])
    assert [row[0] for row in shown] == ["plane", "rgt", "flexroad"]
    for (method, want), (_, got) in zip(shown, measured(f"runs/{name}", folder), strict=True):
        assert got == pytest.approx(want, abs=0.0015, rel=1e-3), method


def test_ground_of_autzen_is_that_of_another_classification(folder):
    cloud = laspy.read(folder / "autzen" / "autzen-thin.las")
    ground = np.asarray(cloud.classification) == 2
    x, y, z = (np.asarray(axis)[ground] * FOOT for axis in (cloud.x, cloud.y, cloud.z))
    points, *figures = told(r"against ([\d,]+) ground points[^.]*:\s*" + FIGURES)
    *got, known = spread(heights(folder / "data/autzen/dtm.tif", x, y) - z)
    assert known == points
    assert got == pytest.approx(figures, abs=0.001)


def test_ground_of_ign_is_that_of_ign(folder):
    own = folder / "ign_crops/l93_770500_6277500/DTM/test_data_77055_627760_LA93_IGN69_50CM.tif"
    with rasterio.open(own) as raster:
        theirs = raster.read(1, masked=True).filled(np.nan)
        row, col = np.mgrid[: raster.height, : raster.width]
        x, y = raster.transform @ (col.ravel() + 0.5, row.ravel() + 0.5)
    cells, *figures = told(r"of it, ([\d,]+) cells\): " + FIGURES)
    *got, known = spread(heights(folder / "data/ign/dtm.tif", x, y) - theirs.ravel())
    assert known == cells
    assert got == pytest.approx(figures, abs=0.001)


@pytest.mark.parametrize("which", ["OpenDRIVE", "vehicles"])
def test_roads_lie_where_map_and_vehicles_say(folder, which):
    scenario = folder / "deepscenario"
    if which == "OpenDRIVE":
        points = np.vstack(reference_lines(scenario / "map" / "map.xodr"))
    else:
        # A vehicle's place is the middle of its foot.
        tracks = pd.read_parquet(next(scenario.glob("annotations/*/annotations.parquet")))
        points = tracks[["translation_x", "translation_y", "translation_z"]].to_numpy()
    x, y, z = points.T
    x, y = x + ZERO[0], y + ZERO[1]
    seen = np.isfinite(heights(folder / "data/deepscenario/dsm.tif", x, y))
    count, *shown = told(rf"\| [^|]*{which}[^|]*" + r"\| ([\d,]+) \| ([\d.]+) \| ([\d.]+) \| ([\d.]+)")
    assert seen.sum() == count
    for variant, want in zip(("plane", "rgt", "flexroad"), shown, strict=True):
        surface = Ground.open(folder / "runs/deepscenario", variant).at(x[seen], y[seen])
        assert abs(surface.height - z[seen]).mean() == pytest.approx(want, abs=0.001)
