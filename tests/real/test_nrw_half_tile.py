"""An original download of Geobasis NRW, the paper's data source."""

import gzip
import shutil

import numpy as np
import pytest
import rasterio

from flexroad.catalog.sources.nrw import index
from flexroad.tasks import TaskError
from flexroad.tasks.load import Options, load

pytestmark = pytest.mark.real

NAME = "dom1_32_356_5699_1_nw_2020.tif"


def test_index_half_square_kilometre_gives_eight_tiles(real_data):
    result = index(real_data / "nrw")
    assert [tile.id for tile in result.tiles] == [
        f"{east}_{north}" for east in (356000, 356250) for north in (5699000, 5699250, 5699500, 5699750)
    ]
    assert {(tile.dataset, tile.datetime.year, tile.datetime_assumed) for tile in result.tiles} == {
        ("Geobasis NRW", 2020, False)
    }
    (note,) = result.notes
    assert note.startswith("no dgm1 file under 356000_5699000")
    with pytest.raises(TaskError, match="the tile has no dtm"):
        load(result.tiles[0], Options())


def test_load_gzipped_xyz_dtm_matches_dsm_cells(real_data, tmp_path):
    shutil.copy(real_data / "nrw" / NAME, tmp_path)
    with rasterio.open(tmp_path / NAME) as src:
        surface = src.read(1)
    # There is no terrain model of this area; 250 m of the surface model, lowered by 10 m, replace it.
    lower = surface[:250, :250] - 10
    north, west = 5700000, 356000
    lines = (
        f"{west + col + 0.5:.2f} {north - row - 0.5:.2f} {lower[row, col]:.2f}"
        for row in range(250)
        for col in range(250)
    )
    (tmp_path / "dgm1_32_356_5699_1_nw.xyz.gz").write_bytes(gzip.compress("\n".join(lines).encode()))
    tile = next(tile for tile in index(tmp_path).tiles if tile.id == "356000_5699750")
    data = load(tile, Options())
    assert data.notes == ("the DSM lies 10.0 m above the DTM: ellipsoidal heights?",)
    assert np.array_equal(data.dsm, surface[:250, :250].astype(float))
    assert np.allclose(data.dsm - data.dtm, 10, atol=0.006)
