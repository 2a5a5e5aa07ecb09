"""The foot bridge over the Willamette beside Autzen Stadium, with a fifth of the points withheld.

``autzen/autzen_river.laz`` has the points of the survey within E 193950 to 194100, N 258750 to 259100 (m).
"""

import shlex

import geopandas as gpd
import laspy
import numpy as np
import pytest
import shapely

import flexroad
from tests.real.shown import flexroad as command

pytestmark = [pytest.mark.real, pytest.mark.slow]

FOOT = 0.3048
SOUTH, NORTH = (193987.1, 258843.6), (194060.8, 259039.2)
"""Ends of the deck, traced from the heights; it is straight."""
WIDTH_M = 4.0
PATHS = [[(193974.4, 258809.9), SOUTH], [NORTH, (194067.9, 259057.9)]]
"""The level ground from which the deck begins."""
PREPARE = "prepare seen.laz --crs EPSG:2994 --cell 0.5 --tile-size 150 --roads roads.gpkg -o data"
RUN = "--allow . run --config production_vector --catalog data/catalog.parquet --out run"


@pytest.fixture(scope="module")
def folder(real_data, tmp_path_factory):
    """Folder with the rasters of the points that are not withheld, and with the roads."""
    path, scan = tmp_path_factory.mktemp("river"), real_data / "autzen" / "autzen_river.laz"
    if not scan.exists():
        pytest.skip(f"{scan} does not exist")
    points = laspy.read(scan)
    withheld = np.random.default_rng(7).random(len(points)) < 0.2
    for name, chosen in (("seen", ~withheld), ("withheld", withheld)):
        part = laspy.LasData(points.header)
        part.points = points.points[chosen]
        part.write(path / f"{name}.laz")
    lines = [shapely.LineString(line) for line in ([SOUTH, NORTH], *PATHS)]
    roads = gpd.GeoDataFrame({"level": [1, 0, 0], "width": WIDTH_M}, geometry=lines, crs="EPSG:2993")
    roads.to_file(path / "roads.gpkg")
    command(shlex.split(PREPARE), path)
    return path


@pytest.fixture(scope="module")
def deck(folder):
    """Withheld points of the deck (m): those near a smooth profile, without rails and water."""
    points = laspy.read(folder / "withheld.laz")
    x, y, z = (FOOT * np.asarray(values) for values in (points.x, points.y, points.z))
    line = shapely.LineString([SOUTH, NORTH])
    on = shapely.contains_xy(shapely.buffer(line, WIDTH_M / 2 - 0.4, cap_style="flat"), x, y) & (z > 131)
    x, y, z = x[on], y[on], z[on]
    along = shapely.line_locate_point(line, shapely.points(x, y)) / line.length
    kept = np.ones(len(z), bool)
    for _ in range(8):
        off = z - np.polyval(np.polyfit(along[kept], z[kept], 6), along)
        kept = np.abs(off) < max(0.3, 2 * np.std(off[kept]))
    return x[kept], y[kept], z[kept]


@pytest.fixture(scope="module")
def view(folder):
    command([*shlex.split(RUN), "--set", "segment.levels=true"], folder)
    return flexroad.open_run(folder / "run")


def test_deck_has_the_height_of_withheld_points(view, deck):
    """The spread of the points about their profile is 0.031 m; with one surface the error is 6.6 m."""
    x, y, z = deck
    assert len(z) > 800
    assert np.abs(view.height(x, y) - z).mean() < 0.03


def test_water_below_the_deck_has_its_own_height(view, deck):
    """The river lies at 124.5 to 125.5 m."""
    x, y, _ = deck
    middle = (y > 258880) & (y < 258980)
    assert view.height(x, y, 0)[middle].max() < 126.5
