"""A genuine download of Geobasis NRW, the paper's own source, by its name."""

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


def test_half_a_kilometre_becomes_eight_tiles(real_data):
    found = index(real_data / "nrw")
    assert [tile.id for tile in found.tiles] == [
        f"{east}_{north}" for east in (356000, 356250) for north in (5699000, 5699250, 5699500, 5699750)
    ]
    assert {(tile.dataset, tile.datetime.year, tile.datetime_assumed) for tile in found.tiles} == {
        ("Geobasis NRW", 2020, False)
    }
    (note,) = found.notes
    assert note.startswith("no dgm1 file under 356000_5699000")
    with pytest.raises(TaskError, match="the tile has no dtm"):
        load(found.tiles[0], Options())


def test_the_terrain_model_as_packed_points_lies_cell_by_cell_on_the_surface_model(real_data, tmp_path):
    shutil.copy(real_data / "nrw" / NAME, tmp_path)
    with rasterio.open(tmp_path / NAME) as src:
        surface = src.read(1)
    # No terrain model of the place is at hand: 250 m of the surface, 10 m lower, stand in for it.
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
    assert data.notes == ()
    assert np.array_equal(data.dsm, surface[:250, :250].astype(float))
    assert np.allclose(data.dsm - data.dtm, 10, atol=0.006)
