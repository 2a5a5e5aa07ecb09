"""Pinned output of `load` and `segment` for one small tile: a change needs a new VERSION and new figures."""

from datetime import UTC, datetime

import numpy as np

from flexroad.catalog import Grid, Layer, Tile
from flexroad.tasks import load
from flexroad.tasks.segment import mask
from tests.make_rasters import UTM, write

PINNED = {
    "versions": (3, 1),
    "dsm": (1391, 120.006118, 52.134236),
    "dtm": (699, 118.97161, 19.40491),
    "road": (756, 626481),
    "outside": (108, 101912),
    "notes": (
        "dsm resampled: its lattice is off by (0.25, -0.40) m",
        "dsm: 1 cell outside -500..9000 m taken as nodata",
        "dtm resampled: its cells are 0.5 m, the tile's 1 m",
        "dtm: 4 cells outside -500..9000 m taken as nodata",
    ),
}


def case(root) -> Tile:
    """Two DSM files off the lattice with a void and an outlier, a DTM at 0.5 m, a land-cover mask."""
    grid = Grid(UTM, 295500.0, 5629500.0, 1.0, 30, 30)
    row, col = np.mgrid[:40, :40].astype(float)
    dsm = 120 + 3 * np.sin(row / 5) + 2 * np.cos(col / 7)
    dsm[:2, 5:9], dsm[20, 20] = np.nan, 1e6
    write(root / "a.tif", dsm[:, :22], grid.west - 4.75, grid.north + 4.6)
    write(root / "b.tif", dsm[:, 22:35], grid.west + 17.25, grid.north + 4.6)
    write(root / "dtm.tif", np.repeat(np.repeat(dsm[5:25] - 1, 2, 0), 2, 1), grid.west, grid.north, cell=0.5)
    cover = ((row // 9 + col // 6) % 4).astype(np.uint8)
    write(root / "cover.tif", cover, grid.west - 4, grid.north + 4)
    layers = (
        Layer("dsm", ("a.tif", "b.tif")),
        Layer("dtm", ("dtm.tif",)),
        Layer("road_mask", ("cover.tif",), values=(1, 3)),
    )
    return Tile("golden", grid, layers, str(root), datetime(2020, 1, 1, tzinfo=UTC))


def summary(heights) -> tuple[int, float, float]:
    """Return the number of values, their mean, and a mean weighted by position."""
    filled = np.where(np.isnan(heights), 0.0, heights)
    weights = np.arange(filled.size).reshape(filled.shape) / filled.size
    mean, weighted = float(np.nanmean(heights)), float((filled * weights).mean())
    return int(np.isfinite(heights).sum()), round(mean, 6), round(weighted, 6)


def test_load_and_segment_output_is_pinned(tmp_path):
    data = load.load(case(tmp_path), load.Options(halo_m=5))
    road = mask.segment(data, mask.Options())
    got = {
        "versions": (load.VERSION, mask.VERSION),
        "dsm": summary(data.dsm),
        "dtm": summary(data.dtm),
        "road": (int(road.mask.sum()), int(np.flatnonzero(road.mask).sum())),
        "outside": (int(road.outside.sum()), int(np.flatnonzero(road.outside).sum())),
        "notes": data.notes,
    }
    assert got == PINNED
