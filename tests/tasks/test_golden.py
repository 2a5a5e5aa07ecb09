"""Pinned output of load, segment, ecsrc, sample and evaluate for small tiles, with the VERSION of each stage.

If the output of a stage changes on purpose, raise its VERSION, so that stored results are computed again, and
update the figures here.
"""

import hashlib
from dataclasses import asdict
from datetime import UTC, datetime

import numpy as np
import pytest
import shapely

from flexroad.catalog import Layer, Tile
from flexroad.tasks import load, sample
from flexroad.tasks.filter import ecsrc
from flexroad.tasks.meshing.road_outline import encoded
from flexroad.tasks.metrics import evaluate
from flexroad.tasks.roads.rasterise import cells
from flexroad.tasks.segment import mask
from flexroad.tasks.types import RoadClusters, RoadMask, Surface, TileData
from tests.builders import make_grid, make_mask, make_tile
from tests.make_rasters import write

GRID = make_grid(90, 80)


class Hills(Surface):
    bounds = GRID.hull

    def height(self, easting, northing):
        x, y = easting - GRID.west, northing - GRID.south
        return 150 + 0.05 * x + 1.5 * np.sin(x / 13) * np.cos(y / 9)

    def lattice(self, eastings, northings):
        return self.height(eastings[None, :], northings[:, None])

    def normal(self, easting, northing):
        raise NotImplementedError


@pytest.fixture(scope="module")
def tile() -> tuple[TileData, RoadMask]:
    """Return two streets and a yard, with a roof over a street, a kerb and ripples in the DSM."""
    x, y = np.meshgrid(GRID.eastings - GRID.west, GRID.northings - GRID.south)
    mask = (np.abs(x - y) < 6) | (np.abs(y - 61) < 4) | (np.hypot(x - 75, y - 15) < 7)
    dtm = Hills().height(GRID.eastings[None, :], GRID.northings[:, None])
    dsm = dtm + 0.05 * np.sin(x * 2.1) * np.sin(y * 1.7)
    dsm[20:30, 25:34] += 6.0
    dsm[(y < 30) & (x - y > 3)] += 0.7
    dsm[:3, :3] = np.nan
    reference = dtm + 0.2 * np.sin(x / 5)
    return make_tile(dsm, dtm, reference=reference), make_mask(mask)


@pytest.fixture(scope="module")
def clusters(tile) -> RoadClusters:
    return ecsrc.ecsrc(*tile, ecsrc.Options(theta_xy_m=4.0))


def digest(*arrays: np.ndarray) -> str:
    return hashlib.sha256(b"".join(np.ascontiguousarray(a).tobytes() for a in arrays)).hexdigest()[:16]


def test_ecsrc_output_is_pinned_to_version(clusters):
    sizes = np.bincount(clusters.labels.ravel())[1:].tolist()
    assert (ecsrc.VERSION, sizes, digest(clusters.labels)) == (1, [1470, 156], "b4c78ef72d54f40e")


@pytest.mark.parametrize(
    ("method", "golden"),
    [
        ("dynamic", (5, 3378, (295500, 5629420, 149.0), "59f68d23c31a3460")),
        ("uniform", (5, 14062, (295500, 5629420, 149.0), "42a4d38a9f74eb42")),
        ("corners", (5, 2, (295500, 5629420, 149.0), "49388a377f0cc530")),
    ],
)
def test_sample_output_is_pinned_to_version(tile, clusters, method, golden):
    mesh = sample.sample(Hills(), tile[1], clusters, sample.Options(method=method))
    # Heights depend on the last digit of the platform's sine; plan coordinates do not.
    shape = digest(mesh.vertices[:, :2], mesh.faces, mesh.road)
    assert (sample.VERSION, len(mesh.faces), mesh.origin, shape) == golden


def test_sample_output_with_lines_is_pinned_to_version(clusters):
    """The survey ends on a slant, and the road is a polygon."""
    x, y = np.meshgrid(GRID.eastings - GRID.west, GRID.northings - GRID.south)
    street = shapely.buffer(shapely.linestrings([(-5, 10.2), (95, 61.7)]), 4.2)
    streets = np.array([shapely.transform(street, lambda points: points + np.array([GRID.west, GRID.south]))])
    mask, outside = cells(streets, GRID), y > 60 - 0.3 * x
    made = RoadMask(GRID, GRID, mask, outside, areas=encoded(streets, GRID))
    mesh = sample.sample(Hills(), made, clusters, sample.Options())
    shape = digest(np.round(mesh.vertices[:, :2] * 1e4), mesh.faces, mesh.road)
    assert (sample.VERSION, len(mesh.faces), shape) == (5, 1328, "db1c233c3108f7d8")


def test_evaluate_output_is_pinned_to_version(tile, clusters):
    mesh = sample.sample(Hills(), tile[1], clusters, sample.Options())
    metrics = asdict(evaluate.evaluate(mesh, *tile, Hills(), evaluate.Options(nearest=True)))
    golden = {
        "l2_road_m": 0.128801681877,
        "l2_terrain_m": 0.143542308943,
        "rmse_road_m": 0.142802953274,
        "rmse_terrain_m": 0.171329502728,
        "nmad_road_m": 0.1850166303,
        "p95_road_m": 0.199498997321,
        "nearest_road_m": 0.128004406058,
        "nearest_terrain_m": 0.142700094559,
        "mad_road_deg": 0.509521750772,
        "mad_terrain_deg": 1.63612316682,
        "triangles": 3378,
        "road_fraction": 0.229583333333,
        "completeness": 1.0,
        "mesh_p95_road_m": 0.00253916405075,
        "mesh_max_road_m": 0.0152919662056,
        "mesh_p95_terrain_m": 0.21038798138,
        "mesh_max_terrain_m": 0.311839098646,
    }
    assert evaluate.VERSION == 3
    assert metrics == pytest.approx(golden, rel=1e-9)


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
    grid = make_grid(30, 30)
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
