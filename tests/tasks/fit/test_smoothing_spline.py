"""The surface of the fit against a literal computation with a direct solver, within 1 mm."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import binary_dilation

from flexroad.catalog.grid import Grid
from flexroad.tasks.fit import smoothing_spline
from flexroad.tasks.spline.frame import Corner, Edge, Frame
from flexroad.tasks.types import RoadClusters, TileData
from flexroad.tools.synthetic import make_scene
from tests import exact_fit

TILE = Grid("EPSG:25832", 500000, 5600500, 1.0, 120, 150)
OPTIONS = smoothing_spline.Options()
MOST_M = 1e-3


def scene(stratum):
    """Return a scene whose DTM is missing beside roads, as the filter leaves it."""
    made = make_scene(TILE, 3, stratum)
    road = made.road_mask
    beside = binary_dilation(road, np.ones((11, 11)))
    dtm = np.where(beside & ~road, np.nan, made.dtm)
    return TileData("t", TILE, TILE, made.dsm, dtm), RoadClusters(TILE, road.astype(np.int32))


def difference(monkeypatch, data, clusters, options=OPTIONS, frame=None):
    """Return the largest difference of the heights at cells (m)."""
    found = []
    for minimum in (smoothing_spline._minimum, exact_fit.minimum):
        with monkeypatch.context() as patch:
            patch.setattr(smoothing_spline, "_minimum", minimum)
            surface = smoothing_spline.fit(data, clusters, options, frame)
        found.append(surface.lattice(data.core.eastings, data.core.northings))
    return np.abs(np.subtract(*found)).max()


def framed(data, clusters, options=OPTIONS):
    """Return a frame whose control points come from a fit of the tile alone, 0.1 m higher."""
    control, p = smoothing_spline.fit(data, clusters, options).A + 0.1, options.degree
    ends = np.zeros((2, 2), bool)

    def corner(rows, cols):
        return Corner(control[rows, cols], ends)

    def edge(rows, cols):
        nothing = np.zeros(0, bool)
        return Edge(control[rows, cols], nothing, nothing, np.zeros((2, 0), bool), np.zeros(0))

    first, middle, last = slice(None, p), slice(p, -p), slice(-p, None)
    return Frame(
        corner(first, first), corner(first, last), corner(last, first), corner(last, last),
        edge(first, middle), edge(last, middle), edge(middle, first), edge(middle, last),
    )  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("stratum", ["urban", "suburban", "rural"])
def test_fit_equals_literal_fit(monkeypatch, stratum):
    data, clusters = scene(stratum)
    assert difference(monkeypatch, data, clusters) < MOST_M
    assert difference(monkeypatch, data, clusters, OPTIONS, framed(data, clusters)) < MOST_M


@pytest.mark.slow
@pytest.mark.parametrize(
    "changes",
    [
        {"bending_m3": 1500.0},
        {"lambda_terrain": 0.0},
        {"spacing_m": 2.0},
        {"spacing_m": 11.0},
        {"degree": 2},
        {"degree": 5, "spacing_m": 8.0},
        {"huber_m": 0.02},
    ],
    ids=str,
)
def test_fit_with_other_options_equals_literal_fit(monkeypatch, changes):
    data, clusters = scene("urban")
    options = OPTIONS.model_copy(update=changes)
    frame = framed(data, clusters, options)
    assert difference(monkeypatch, data, clusters, options, frame) < MOST_M


@pytest.mark.slow
@pytest.mark.parametrize("stratum", ["urban", "rural"])
@pytest.mark.parametrize("void", ["hole", "half", "scattered"])
def test_fit_over_void_equals_literal_fit(monkeypatch, void, stratum):
    """Where there is no height, only the bending energy determines the surface."""
    data, clusters = scene(stratum)
    rows, cols = np.indices(TILE.shape)
    lost = {
        "hole": np.hypot(rows - 70, cols - 60) < 45,
        "half": rows > 80,
        "scattered": np.random.default_rng(0).random(TILE.shape) < 0.7,
    }[void]
    data = replace(data, dsm=np.where(lost, np.nan, data.dsm), dtm=np.where(lost, np.nan, data.dtm))
    frame = None if void == "scattered" else framed(*scene(stratum))
    assert difference(monkeypatch, data, clusters, OPTIONS, frame) < MOST_M


def test_fit_repeated_gives_equal_bits():
    data, clusters = scene("rural")
    one, other = (smoothing_spline.fit(data, clusters, OPTIONS).A.tobytes() for _ in range(2))
    assert one == other
