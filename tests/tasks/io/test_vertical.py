from datetime import UTC, datetime

import numpy as np
import pytest

from flexroad.catalog import Grid, Layer, Tile
from flexroad.tasks.io.dsm_and_dtm import vertical_crs
from tests.make_rasters import UTM, write

GRID = Grid(UTM, 295500.0, 5629480.0, 1.0, 20, 20)
DHHN = "EPSG:25832+7837"


def tile(root, dsm, dtm, given=None) -> Tile:
    """A tile whose DSM and DTM declare these CRSs; ``given`` is the one of files without."""
    for name, crs in (("dsm", dsm), ("dtm", dtm)):
        write(root / f"{name}.tif", np.full((20, 20), 100.0), GRID.west, GRID.north, crs=crs)
    layers = tuple(Layer(name, (f"{name}.tif",), (), given) for name in ("dsm", "dtm"))
    return Tile("a", GRID, layers, str(root), datetime(2020, 5, 1, tzinfo=UTC))


@pytest.mark.parametrize(
    ("dsm", "dtm", "given", "expected"),
    [
        (DHHN, DHHN, None, "EPSG:7837"),
        (DHHN, UTM, None, None),
        (DHHN, "EPSG:25832+5783", None, None),
        (UTM, UTM, None, None),
        (None, None, DHHN, "EPSG:7837"),
        (DHHN, None, None, None),
    ],
)
def test_vertical_crs_is_known_if_all_heights_declare_the_same(dsm, dtm, given, expected, tmp_path):
    assert vertical_crs(tile(tmp_path, dsm, dtm, given)) == expected


def test_vertical_crs_ignores_a_file_that_cannot_be_read(tmp_path):
    made = tile(tmp_path, DHHN, DHHN)
    (tmp_path / "dtm.tif").write_bytes(b"no raster")
    assert vertical_crs(made) == "EPSG:7837"
