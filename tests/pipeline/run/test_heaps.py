"""A production run over smooth heaps on a car park, and over decks on ramps: the surface is the road's."""

import numpy as np
import pytest

import flexroad
from flexroad.catalog import Catalog
from flexroad.catalog.sources import rasters
from flexroad.pipeline.config.loading import load_config
from flexroad.pipeline.execute import SerialExecutor
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.run.runner import run_tiles
from tests import make_rasters

WEST, NORTH, SIDE = 295500, 5629500, 250
HIGH = 6.0
HEAPS = {
    "cone": (35, lambda away: np.clip(HIGH - 0.4 * away, 0, None)),
    "flat top": (95, lambda away: np.clip(HIGH - (away - 6) / 2, 0, HIGH)),
    "half cosine": (155, lambda away: HIGH / 2 * (1 + np.cos(np.pi * np.clip(away / 18, 0, 1)))),
    "bell": (215, lambda away: HIGH * np.exp(-((away / 4.5) ** 2) / 2)),
}
"""Column of the middle of each heap, in row 70, and its height by the distance from there (m)."""
DECKS = {"ramps in the DTM": 165, "ramps not in the DTM": 215}
"""Middle row of each road with a deck."""


@pytest.fixture(scope="module")
def scene():
    """Surface, terrain, mask and true height of the road on one tile (m)."""
    row, col = np.indices((SIDE, SIDE))
    dsm, dtm, road = np.full((3, SIDE, SIDE), 150.0)
    mask = (row >= 10) & (row < 130) & (col >= 5) & (col < 245)
    for middle, height in HEAPS.values():
        dsm = dsm + height(np.hypot(row - 70, col - middle))
    away = np.abs(col - 124.5)
    rise = np.clip(HIGH - 0.1 * np.clip(away - 20, 0, None), 0, None)
    for name, middle in DECKS.items():
        lane = np.abs(row - middle) <= 6
        mask, road, dsm = mask | lane, road + rise * lane, dsm + rise * lane
        dtm = dtm + rise * lane * ((name == "ramps in the DTM") & (away > 30))
    noise = 0.03 * np.random.default_rng(1).standard_normal(dsm.shape)
    return dsm + noise, dtm, mask, road


@pytest.fixture(scope="module")
def surface(scene, tmp_path_factory):
    """Heights of the run's surface in the middle of the cells (m)."""
    folder = tmp_path_factory.mktemp("heaps")
    layers = dict(zip(("dsm", "dtm", "road_mask"), scene[:3], strict=True))
    for name, values in layers.items():
        make_rasters.write(
            folder / f"{name}.tif", values.astype("uint8" if name == "road_mask" else "float32")
        )
    catalog = rasters.index(folder, {name: f"{name}.tif" for name in layers}, road_values=(1,))
    run = Run.create(folder / "run", load_config("production"), Catalog(catalog.tiles))
    assert run_tiles(run, SerialExecutor()).exit_code == 0
    east, north = np.meshgrid(WEST + np.arange(SIDE) + 0.5, NORTH - np.arange(SIDE) - 0.5)
    return flexroad.open_run(folder / "run").height(east.ravel(), north.ravel()).reshape(east.shape)


@pytest.mark.parametrize("shape", HEAPS)
def test_run_over_heap_stays_on_car_park(scene, surface, shape):
    dsm, _, _, road = scene
    on = np.zeros_like(road, bool)
    on[40:100, HEAPS[shape][0] - 30 : HEAPS[shape][0] + 30] = True
    assert (dsm - road)[on].max() > HIGH - 0.5
    assert np.abs(surface - road)[on].max() < 0.35


@pytest.mark.parametrize("name", DECKS)
def test_run_over_deck_on_ramps_follows_deck(scene, surface, name):
    """The surface rounds the edges between deck and ramps, so 4 m beside them are left out."""
    road = scene[3]
    lane = np.s_[DECKS[name] - 4 : DECKS[name] + 5, 10:240]
    assert road[lane].max() - road.min() == HIGH
    away = np.abs(np.arange(10, 240) - 124.5)
    inside = (np.abs(away - 20) > 4) & (np.abs(away - 80) > 4)
    assert np.abs(surface - road)[lane][:, inside].max() < 0.05
