"""ECSRC compared with Algorithm 1 written with Python sets, on a 250 x 250 tile with 20% road."""

import numpy as np
from scipy.ndimage import gaussian_filter

from flexroad.catalog.grid import Grid
from flexroad.tasks.filter.ecsrc import Options, ecsrc
from flexroad.tasks.types import RoadMask, TileData
from tests.bench.timing import cpu_s
from tests.tasks.filter import ecsrc_oracle as oracle

SIZE, SHARE = 250, 0.2


def case(relief_m: float) -> tuple[TileData, RoadMask]:
    """Return a tile with patches of road on hilly ground, with noise in proportion to the relief."""
    rng = np.random.default_rng(1)
    field = gaussian_filter(rng.standard_normal((SIZE, SIZE)), 8)
    mask = field > np.quantile(field, 1 - SHARE)
    ground = gaussian_filter(rng.standard_normal((SIZE, SIZE)), 3)
    dsm = 150 + relief_m * (ground / ground.std() + 0.1 * rng.standard_normal((SIZE, SIZE)))
    grid = Grid("EPSG:25832", 295500.0, 5629500.0, 1.0, SIZE, SIZE)
    return TileData("bench", grid, grid, dsm, dsm), RoadMask(grid, grid, mask, np.zeros_like(mask))


def main() -> None:
    options = Options()
    print(f"{'relief':>8} {'sets':>10} {'FlexRoad':>10} {'ratio':>7}  labels")
    for relief_m in (0.2, 1.0, 4.0):
        data, road = case(relief_m)
        labels = ecsrc(data, road, options).labels
        expected = oracle.labels(road.mask, data.dsm, 1.0, options)
        slow = cpu_s(lambda data=data, road=road: oracle.labels(road.mask, data.dsm, 1.0, options), 2)
        fast = cpu_s(lambda data=data, road=road: ecsrc(data, road, options), 20)
        same = "equal" if np.array_equal(labels, expected) else "DIFFERENT"
        print(f"{relief_m:6.1f} m {1e3 * slow:7.0f} ms {1e3 * fast:7.1f} ms {slow / fast:7.0f}  {same}")


if __name__ == "__main__":
    main()
