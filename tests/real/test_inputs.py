"""Real surveys as downloaded: three UMEP cities, a DSM of Geobasis NRW, and roads around a stadium."""

import gzip
import shutil
import zipfile

import numpy as np
import pytest
import rasterio

from flexroad.catalog import Grid
from flexroad.catalog.sources import nrw
from flexroad.catalog.sources.rasters import index
from flexroad.tasks import TaskError
from flexroad.tasks.filter import planar
from flexroad.tasks.fit import smoothing_spline
from flexroad.tasks.load import Options, load
from flexroad.tasks.roads import rasterise
from flexroad.tasks.segment import mask, vector
from flexroad.tasks.types import Source, TileData
from tests import exact_fit

pytestmark = pytest.mark.real


BARBICAN = {"dsm": "dsm_barb*.tif", "dtm": "dem_barb*.tif", "road_mask": "landcover*.tif"}


@pytest.fixture
def unpack(real_data, tmp_path):
    def unpacked(name):
        with zipfile.ZipFile(real_data / "umep" / f"{name}.zip") as archive:
            archive.extractall(tmp_path)
        return tmp_path / name if (tmp_path / name).is_dir() else tmp_path

    return unpacked


def test_barbican_corner_off_by_rounding_is_copied(unpack):
    """651 x 601 m, corner 0.1 mm off the metre: copied, not resampled; nine tiles, three slivers left out."""
    folder = unpack("London_BNG")
    result = index(folder, BARBICAN, road_values=(1,))
    assert len(result.tiles) == 9
    assert result.tiles[4].id == "532250_181500"
    assert {t.grid.crs for t in result.tiles} == {"EPSG:27700"}
    assert {t.grid.cell for t in result.tiles} == {1.0}
    assert result.notes[0].startswith("left out 3 tiles with a DSM height in less than 25%")
    data = [load(t, Options()) for t in result.tiles]
    assert all(d.notes == () for d in data)
    full = data[4]
    assert np.isfinite(full.dsm).all()
    assert np.isfinite(full.dtm).all()
    assert 4 < full.dtm.min() < full.dtm.max() < 26
    assert 40 < full.dsm.max() < 146
    roads = [mask.segment(d, mask.Options()) for d in data]
    assert 0.40 < roads[4].mask.mean() < 0.50
    assert not roads[4].outside.any()
    # The survey ends 40 m before the northern edge of the tiles.
    assert roads[5].outside.sum() == np.isnan(data[5].dsm).sum() == 40 * 250
    unmatched = sum(np.count_nonzero(r.mask & np.isnan(d.dsm)) for r, d in zip(roads, data, strict=True))
    assert unmatched == 0


@pytest.mark.slow
@pytest.mark.parametrize("number", range(9))
def test_fit_of_barbican_equals_literal_fit(unpack, monkeypatch, number):
    """The fit of production is within 1 mm of a literal computation with a direct solver."""
    data = load(index(unpack("London_BNG"), BARBICAN, road_values=(1,)).tiles[number], Options())
    clusters = planar.ecsrc(data, mask.segment(data, mask.Options()), planar.Options(shoulder_m=5))
    surfaces = []
    for literal in (False, True):
        if literal:
            monkeypatch.setattr(smoothing_spline, "_minimum", exact_fit.minimum)
        surface = smoothing_spline.fit(data, clusters, smoothing_spline.Options())
        surfaces.append(surface.lattice(data.core.eastings, data.core.northings))
    # Beyond the survey there is nothing to hold the surface.
    near = np.isfinite(data.dsm)[data.grid.window(data.core)]
    assert np.abs(surfaces[0] - surfaces[1])[near].max() < 1e-3


def test_gothenburg_local_crs_and_partial_tile_loads(unpack):
    """A city's own CRS, land cover as float32 without class names, less than one tile."""
    folder = unpack("Goteborg_SWEREF99_1200")
    layers = {"dsm": "DSM_KRbig.tif", "dtm": "DEM_KRbig.tif", "road_mask": "landcover.tif"}
    result = index(folder, layers, road_values=(1,))
    assert [t.id for t in result.tiles] == ["147750_6398500"]
    assert result.tiles[0].grid.crs == "EPSG:3007"
    data = load(result.tiles[0], Options())
    # 147720..147954 and 6398557..6398780 overlap the tile by 204 x 193 m.
    assert np.isfinite(data.dsm).sum() == 204 * 193
    assert np.nanmin(np.nanmax(data.dsm) - np.nanmax(data.dtm)) > 0.9
    road = mask.segment(data, mask.Options())
    assert road.outside.sum() == 250 * 250 - 204 * 193
    assert 0.2 < road.mask.mean() < 0.25


def test_covent_garden_shifted_lattice_is_resampled_with_note(unpack):
    """Cells off the whole metre are resampled with a note; without land cover there is no mask."""
    result = index(unpack("DataCoventGarden"), {"dsm": "DSM_CG.tif", "dtm": "DEM_CG.tif"})
    assert len(result.tiles) == 5
    tile = next(t for t in result.tiles if t.id == "283250_5711250")
    data = load(tile, Options())
    assert data.notes == (
        "dsm resampled: its lattice is off by (0.09, 0.31) m",
        "dtm resampled: its lattice is off by (0.09, 0.31) m",
    )
    assert np.isfinite(data.dsm).all()
    assert 6.5 < data.dtm.min() < data.dtm.max() < 25.5
    assert not mask.segment(data, mask.Options()).mask.any()


def test_index_ascii_grid_uses_given_crs(unpack):
    folder = unpack("Goteborg_SWEREF99_1200")
    (tile,) = index(folder, {"dsm": "CDSM_KRbig.asc"}, crs="EPSG:3007").tiles
    assert tile.layers[0].crs == "EPSG:3007"


NAME = "dom1_32_356_5699_1_nw_2020.tif"


def test_index_half_square_kilometre_gives_eight_tiles(real_data):
    result = nrw.index(real_data / "nrw")
    assert [tile.id for tile in result.tiles] == [
        f"{east}_{north}" for east in (356000, 356250) for north in (5699000, 5699250, 5699500, 5699750)
    ]
    assert {(tile.dataset, tile.datetime.year, tile.datetime_assumed) for tile in result.tiles} == {
        ("Geobasis NRW", 2020, False)
    }
    heights = [
        load(tile, Options()).dsm for tile in index(real_data / "nrw", {"dsm": NAME, "dtm": NAME}).tiles
    ]
    assert all(np.isfinite(h).all() for h in heights)
    assert min(h.min() for h in heights) == pytest.approx(87.29, abs=0.01)
    assert max(h.max() for h in heights) == pytest.approx(167.28, abs=0.01)
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
    tile = next(tile for tile in nrw.index(tmp_path).tiles if tile.id == "356000_5699750")
    data = load(tile, Options())
    assert data.notes == ("the DSM lies 10.0 m above the DTM: ellipsoidal heights?",)
    assert np.array_equal(data.dsm, surface[:250, :250].astype(float))
    assert np.allclose(data.dsm - data.dtm, 10, atol=0.006)


NORTH = Grid.covering("EPSG:2993", (193_500, 259_500, 195_000, 260_250), 1.0)
"""The whole northern area, with cells of 1 m."""
CERTAIN = "class = 'road' AND certainty <> 'low'"


@pytest.fixture
def north(real_data) -> TileData:
    path = real_data / "autzen" / "roads" / "autzen_north_roads.gpkg"
    flat = np.zeros(NORTH.shape)
    return TileData("north", NORTH, NORTH, flat, flat, roads=Source("roads", (path,)))


def iou(data: TileData, **options) -> float:
    """IoU of centre lines and polygons, without the cells of uncertain polygons."""
    areas = f"{CERTAIN} AND visible_in <> 'rgb'"
    truth = rasterise.rasterise_roads(data, rasterise.Options(layer="road_polygons", where=areas))
    uncertain = rasterise.rasterise_roads(
        data, rasterise.Options(layer="road_polygons", where="class = 'road' AND certainty = 'low'")
    )
    mask = vector.segment(data, vector.Options(layer="road_centerlines", where=CERTAIN, **options)).mask
    return float((mask & truth)[~uncertain].sum() / (mask | truth)[~uncertain].sum())


def test_segment_centre_lines_with_own_width_match_roads(north):
    assert iou(north) >= 0.85


def test_segment_single_width_matches_worse(north):
    """7.5 m is the median width of the lines, 12 m about their mean weighted by length."""
    for width, most in ((7.5, 0.62), (12.0, 0.72)):
        assert iou(north, width_columns=(), class_columns=(), default_width_m=width) < most
