import pickle
import warnings
from dataclasses import replace
from datetime import UTC, datetime

import numpy as np
import pytest
from affine import Affine
from hypothesis import given, settings
from hypothesis import strategies as st
from rasterio.enums import Resampling
from rasterio.warp import transform

from flexroad.catalog import Grid, Layer, Tile
from flexroad.catalog.borders import border_of
from flexroad.catalog.sources import rasters
from flexroad.tasks import TaskError
from flexroad.tasks.io.raster import misalignment, read_window, resample_to
from flexroad.tasks.load import Options, load, load_border
from tests.make_rasters import UTM, write, write_xyz

GRID = Grid(UTM, 295500.0, 5629480.0, 1.0, 20, 20)
"""A tile of 20 m."""
NORTH = {"west": GRID.west, "north": GRID.north}


@pytest.fixture(autouse=True)
def quiet():
    """Turn warnings into errors: a run of 10,000 tiles would repeat them."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.simplefilter("ignore", PendingDeprecationWarning)  # affine's, raised inside rasterio
        yield


def tile(root, *, values=(), crs=None, grid=GRID, **files):
    files = {"dsm": "dsm.tif", "dtm": "dtm.tif"} | files
    layers = tuple(
        Layer(name, (names,) if isinstance(names, str) else tuple(names), values, crs)
        for name, names in files.items()
        if names
    )
    return Tile("295500_5629460", grid, layers, str(root), datetime(2020, 5, 1, tzinfo=UTC))


def relief(height=20, width=20, seed=0):
    return np.random.default_rng(seed).uniform(100, 130, (height, width))


def plane(grid, a=0.3, b=-0.2):
    e, n = np.meshgrid(grid.eastings, grid.northings)
    return 100 + a * (e - GRID.west) + b * (n - GRID.north)


def fails(tile, options=None):
    """Load a tile that fails; return the message and the file of the error."""
    with pytest.raises(TaskError) as caught:
        load(tile, options or Options())
    assert "\n" not in str(caught.value)
    return str(caught.value), caught.value.file


@pytest.fixture
def models(tmp_path):
    write(tmp_path / "dsm.tif", relief(), **NORTH)
    write(tmp_path / "dtm.tif", relief(seed=9), **NORTH)


def test_load_coinciding_cells_are_copied(tmp_path):
    dsm, dtm = relief(30, 40), relief(30, 40, seed=1)
    write(tmp_path / "dsm.tif", dsm, GRID.west - 5, GRID.north + 3)
    write(tmp_path / "dtm.tif", dtm.astype(np.float32), GRID.west - 5, GRID.north + 3)
    data = load(tile(tmp_path), Options())
    assert data.dsm.dtype == data.dtm.dtype == np.float64
    np.testing.assert_array_equal(data.dsm, dsm[3:23, 5:25])
    np.testing.assert_array_equal(data.dtm, dtm.astype(np.float32)[3:23, 5:25])
    assert (data.tile_id, data.grid, data.core, data.notes) == ("295500_5629460", GRID, GRID, ())
    assert data.road_mask is data.reference is data.reference_road is None


def test_load_offset_below_tolerance_is_copied(tmp_path, models):
    dsm = relief()
    write(tmp_path / "dsm.tif", dsm, GRID.west + 0.009, GRID.north - 0.009, cell=1.00000001)
    data = load(tile(tmp_path), Options())
    np.testing.assert_array_equal(data.dsm, dsm)
    assert data.notes == ()


@settings(max_examples=30)
@given(row=st.integers(-25, 25), col=st.integers(-25, 25), size=st.tuples(*2 * [st.integers(1, 45)]))
def test_load_any_position_puts_cells_in_place(tmp_path_factory, row, col, size):
    root = tmp_path_factory.mktemp("window")
    write(root / "dtm.tif", relief(seed=1), **NORTH)
    dsm = relief(*size)
    write(root / "dsm.tif", dsm, GRID.west + col, GRID.north - row)
    want = np.full((100, 100), np.nan)
    want[25 + row : 25 + row + size[0], 25 + col : 25 + col + size[1]] = dsm
    want = want[25:45, 25:45]
    if np.isnan(want).all():
        assert "no dsm file overlaps the tile" in fails(tile(root), Options(min_valid=0))[0]
    else:
        np.testing.assert_array_equal(load(tile(root), Options(min_valid=0)).dsm, want)


def test_load_overlapping_files_use_first_value(tmp_path, models):
    left, right = relief(20, 12), relief(20, 12, seed=1)
    left[4, 9] = np.nan
    write(tmp_path / "a.tif", left, **NORTH)
    write(tmp_path / "b.tif", right, GRID.west + 8, GRID.north)
    data = load(tile(tmp_path, dsm=("a.tif", "b.tif")), Options())
    want = np.hstack([left, right[:, 4:]])
    want[4, 9] = right[4, 1]
    np.testing.assert_array_equal(data.dsm, want)


def test_load_halo_reads_neighbouring_files(tmp_path):
    whole = relief(40, 40)
    for name, cols in {"a": slice(0, 20), "b": slice(20, 40)}.items():
        write(tmp_path / f"{name}.tif", whole[:, cols], GRID.west + cols.start, GRID.north)
    tile_with_files = tile(tmp_path, dsm=("a.tif", "b.tif"), dtm=("a.tif", "b.tif"))
    data = load(tile_with_files, Options(halo_m=7))
    assert (data.grid, data.core) == (GRID.buffered(7), GRID)
    np.testing.assert_array_equal(data.dsm[data.grid.window(data.core)], whole[:20, :20])
    np.testing.assert_array_equal(data.dsm[7:, 7:], whole[:27, :27])
    assert np.isnan(data.dsm[:7]).all()
    assert np.isnan(data.dsm[:, :7]).all()


def test_load_opens_only_files_that_reach_the_grid(tmp_path):
    """The file beside the tile does not exist, which is noted only with a halo that reaches it."""
    whole = relief()
    whole[3, 3] = np.nan
    for name in ("dsm.tif", "dtm.tif"):
        write(tmp_path / name, whole, **NORTH)
    beside = (GRID.east + 5, GRID.south, GRID.east + 25, GRID.north)
    layers = tuple(
        Layer(name, (f"{name}.tif", "gone.tif"), extents=(GRID.bounds, beside)) for name in ("dsm", "dtm")
    )
    tile_with_files = Tile("a", GRID, layers, str(tmp_path), datetime(2020, 5, 1, tzinfo=UTC))
    assert load(tile_with_files, Options(halo_m=5)).notes == ()
    assert len(load(tile_with_files, Options(halo_m=6)).notes) == 2


def test_load_other_formats_give_same_heights(tmp_path, models):
    dsm = relief().round(2)
    write_xyz(tmp_path / "down.xyz", dsm, **NORTH)
    write_xyz(tmp_path / "up.xyz", dsm, **NORTH, northward=True)
    write(tmp_path / "a.asc", dsm, **NORTH, driver="AAIGrid", crs=None)
    write(tmp_path / "a.tif", dsm, **NORTH)
    for name in ("down.xyz", "up.xyz", "a.asc"):
        data = load(tile(tmp_path, dsm=name, crs=UTM), Options())
        # XYZ files are read as float32, the ASCII grid with the digits that were written.
        np.testing.assert_allclose(data.dsm, dsm, atol=1e-5, err_msg=name)
        assert data.notes == (), name


@pytest.mark.parametrize(
    ("rows", "above", "note"),
    [
        (20, 47.0, "the DSM lies 47.0 m above the DTM: ellipsoidal heights?"),
        (20, -4.0, "the DSM lies 4.0 m below the DTM: ellipsoidal heights, or are their files swapped?"),
        (10, -4.0, "in 50% of the cells and above it in 0%: are their files swapped?"),
    ],
)
def test_load_offset_or_swapped_models_give_one_note(tmp_path, rows, above, note):
    dsm = plane(GRID)
    write(tmp_path / "dtm.tif", dsm, **NORTH)
    dsm[:rows] += above
    write(tmp_path / "dsm.tif", dsm, **NORTH)
    (found,) = load(tile(tmp_path), Options(halo_m=0)).notes
    assert found.endswith(note)


@pytest.mark.parametrize(
    ("cell", "west", "north", "note"),
    [(cell, 20, 20, f"its cells are {cell:g} m, the tile's 1 m") for cell in (0.25, 0.5, 2.0)]
    + [(1.0, 9.91, 10.31, "its lattice is off by (0.09, 0.31) m")],
)
def test_load_other_lattice_is_resampled_with_note(tmp_path, models, cell, west, north, note):
    n = round(60 / cell)
    other = Grid(UTM, GRID.west - west, GRID.north + north, cell, n, n)
    write(tmp_path / "dsm.tif", plane(other), other.west, other.north, cell=cell)
    data = load(tile(tmp_path), Options())
    np.testing.assert_allclose(data.dsm, plane(GRID), atol=1e-6)
    assert data.notes[0] == f"dsm resampled: {note}"


def test_load_resampling_ignores_cells_without_value(tmp_path, models):
    """Bilinear weights without the weights of voids, normalised to one; voids keep their size."""
    source = relief(24, 24)
    source[8:11, 9] = np.nan
    source[15, 15] = 1e30
    off = 0.25
    write(tmp_path / "dsm.tif", source, GRID.west - 2 + off, GRID.north + 2)
    data = load(tile(tmp_path), Options())
    heights = np.where(source < 1e4, source, np.nan)
    left, right = heights[2:22, 1:21], heights[2:22, 2:22]
    w = np.array([off, 1 - off])[:, None, None] * ~np.isnan([left, right])
    want = np.nansum([w[0] * left, w[1] * right], axis=0) / w.sum(axis=0)
    want[np.isnan(right)] = np.nan
    np.testing.assert_allclose(data.dsm, want, atol=1e-6)
    assert data.notes == (
        "dsm resampled: its lattice is off by (0.25, 0.00) m",
        "dsm: 1 cell outside -500..9000 m taken as nodata",
    )


def test_load_mask_is_resampled_to_nearest(tmp_path, models):
    fine = np.repeat(np.repeat(np.array([[1, 3], [2, 1]], np.uint8), 20, 0), 20, 1)
    write(tmp_path / "mask.tif", fine, GRID.west + 0.1, GRID.north, cell=0.5)
    data = load(tile(tmp_path, road_mask="mask.tif", values=(2,)), Options())
    want = np.zeros((20, 20), bool)
    want[10:, :10] = True
    np.testing.assert_array_equal(data.road_mask, want)
    assert data.notes == ("road_mask resampled: its cells are 0.5 m, the tile's 1 m",)


@pytest.mark.parametrize("nodata", [-9999.0, -3.4028234663852886e38, float("nan"), 0.0])
def test_load_declared_nodata_is_nan_without_note(tmp_path, models, nodata):
    dsm = relief().astype(np.float32)
    dsm[3, 4] = nodata
    write(tmp_path / "dsm.tif", dsm, **NORTH, nodata=nodata)
    data = load(tile(tmp_path), Options())
    assert np.argwhere(np.isnan(data.dsm)).tolist() == [[3, 4]]
    assert data.notes == ()


def test_load_invalid_heights_are_nan_with_note(tmp_path, models):
    dsm = relief()
    dsm[0, :6] = [np.inf, -np.inf, 1e30, -9999, 9001, np.nan]
    dsm[1, :2] = [-499, 8999]
    write(tmp_path / "dsm.tif", dsm, **NORTH)
    data = load(tile(tmp_path), Options())
    assert np.argwhere(np.isnan(data.dsm)).tolist() == [[0, i] for i in range(6)]
    assert data.notes == ("dsm: 5 cells outside -500..9000 m taken as nodata",)


FOOT = 1200 / 3937


@pytest.mark.parametrize(
    ("metres", "offset", "crs", "form"),
    [
        (0.3048, 0, UTM, {"unit": "ft"}),
        (FOOT, 0, UTM, {"unit": "US survey foot"}),
        (1.0, 0, UTM, {"unit": "m"}),
        (0.01, 0, UTM, {"unit": "cm"}),
        # UTM 10N in metres with heights in feet (NAVD88, ftUS).
        (FOOT, 0, "EPSG:26910+6360", {}),
        (0.01, 50, UTM, {"scale": (0.01, 50.0)}),
    ],
)
def test_load_heights_become_metres(tmp_path, metres, offset, crs, form):
    stored = np.round((relief() - offset) / metres)
    for name in ("dsm.tif", "dtm.tif"):
        write(tmp_path / name, stored.astype(np.int32), **NORTH, crs=crs, **form)
    data = load(tile(tmp_path, grid=replace(GRID, crs=crs.partition("+")[0])), Options())
    np.testing.assert_allclose(data.dsm, stored * metres + offset, rtol=1e-12)
    np.testing.assert_array_equal(data.dtm, data.dsm)


def test_load_masks_use_road_values_and_the_reference_is_read(tmp_path, models):
    classes = np.random.default_rng(3).integers(0, 4, (20, 20)).astype(np.uint8)
    write(tmp_path / "mask.tif", classes, **NORTH, nodata=3)
    masks = {"road_mask": "mask.tif", "reference_road": "mask.tif"}
    named = load(tile(tmp_path, **masks, reference="dtm.tif", values=(1, 2)), Options())
    np.testing.assert_array_equal(named.reference, relief(seed=9))
    np.testing.assert_array_equal(named.road_mask, np.isin(classes, (1, 2)))
    np.testing.assert_array_equal(named.reference_road, np.isin(classes, (1, 2)))
    nonzero = load(tile(tmp_path, road_mask="mask.tif"), Options(halo_m=2))
    want = np.pad(np.isin(classes, (1, 2)), 2)
    np.testing.assert_array_equal(nonzero.road_mask, want)
    assert nonzero.road_mask.dtype == np.bool_


def test_load_mask_without_georeference_needs_tile_size(tmp_path, models):
    mask = np.tri(20, dtype=np.uint8)
    for name, values in {"same.tif": mask, "other.tif": mask[:19]}.items():
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            write(tmp_path / name, values, crs=None, transform=Affine.identity())
    data = load(tile(tmp_path, road_mask="same.tif"), Options(halo_m=1))
    np.testing.assert_array_equal(data.road_mask[1:-1, 1:-1], mask)
    message, file = fails(tile(tmp_path, road_mask="other.tif"))
    assert message.startswith(
        "road_mask other.tif has no georeference and has 20 x 19 cells, the tile 20 x 20"
    )
    assert file == str(tmp_path / "other.tif")


def test_load_missing_layer_fails(tmp_path, models):
    assert fails(tile(tmp_path, dsm=None))[0].startswith("the tile has no dsm; give its files")
    assert "with --dtm" in fails(tile(tmp_path, dtm=None))[0]
    message, _ = fails(tile(tmp_path), Options(road_height="layer"))
    assert message == "the tile has no road_height; give its files to `flexroad catalog` with --road-height"


def test_task_error_can_be_pickled():
    copy = pickle.loads(pickle.dumps(TaskError("no dsm", "a.tif", "dsm")))
    assert (str(copy), copy.file, copy.layer) == ("no dsm", "a.tif", "dsm")


def test_load_file_outside_tile_fails(tmp_path, models):
    write(tmp_path / "dsm.tif", relief(), GRID.west + 500, GRID.north)
    message, file = fails(tile(tmp_path))
    assert message.startswith("no dsm file overlaps the tile (295500 5629460 295520 5629480): dsm.tif")
    assert file == str(tmp_path / "dsm.tif")


@pytest.fixture
def other_crs(tmp_path):
    """A file over the tile in zone 33."""
    (east,), (north,) = transform(UTM, "EPSG:25833", [GRID.west - 10], [GRID.north + 10])
    return write(tmp_path / "other.tif", relief(40, 40), east, north, crs="EPSG:25833")


def test_load_layer_in_other_crs_fails_and_is_left_out_of_a_border(tmp_path, models, other_crs):
    """It fails the tile that it lies on, not those around."""
    message, file = fails(tile(tmp_path, dtm="other.tif"))
    assert message == (
        "dtm other.tif is in EPSG:25833, the tile in EPSG:25832; reproject it, "
        "e.g. gdalwarp -t_srs EPSG:25832, or make the catalog with --reproject"
    )
    assert file == str(other_crs)
    place = tile(tmp_path, dtm=("other.tif", "dtm.tif"))
    np.testing.assert_array_equal(load_border(place, GRID, Options()).dtm, relief(seed=9))
    # Beside the tile it is ignored.
    write(tmp_path / "far.tif", relief(), **NORTH, crs="EPSG:25833")
    data = load(tile(tmp_path, dtm=("far.tif", "dtm.tif")), Options())
    np.testing.assert_array_equal(data.dtm, relief(seed=9))


def test_load_file_in_local_crs_fails(tmp_path, models):
    """A site's own coordinates cannot be transformed."""
    site = 'LOCAL_CS["my site",UNIT["metre",1],AXIS["Easting",EAST],AXIS["Northing",NORTH]]'
    path = write(tmp_path / "dsm.tif", relief(), **NORTH, crs=site)
    assert "dsm dsm.tif is in my site, the tile in EPSG:25832; reproject it" in fails(tile(tmp_path))[0]
    path.write_bytes(path.read_bytes().replace(b"my site", b"my s\xf3te"))
    assert "dsm dsm.tif cannot be read: 'utf-8' codec can't decode" in fails(tile(tmp_path))[0]


def test_load_mixed_units_fail(tmp_path, models):
    write(tmp_path / "dsm.tif", relief(), **NORTH, unit="ft")
    message, file = fails(tile(tmp_path))
    assert message.startswith("dsm dsm.tif has heights in ft, dtm dtm.tif in metre; ")
    assert file == str(tmp_path / "dtm.tif")


def test_load_too_few_heights_fails(tmp_path, models):
    dsm = np.full((20, 20), np.nan)
    write(tmp_path / "dsm.tif", dsm, **NORTH)
    assert "dsm dsm.tif has only nodata on this tile" in fails(tile(tmp_path))[0]
    dsm.flat[:49] = 100
    write(tmp_path / "dsm.tif", dsm, **NORTH)
    message, file = fails(tile(tmp_path))
    assert "has 12.3% valid cells on this tile, below 25%; lower load.min_valid" in message
    assert file == str(tmp_path / "dsm.tif")
    assert np.isfinite(load(tile(tmp_path), Options(min_valid=0.1)).dsm).sum() == 49


def test_load_data_only_in_halo_fails(tmp_path):
    for name in ("dsm.tif", "dtm.tif"):
        write(tmp_path / name, relief(40, 20), GRID.west - 20, GRID.north + 10)
    assert "has only nodata" in fails(tile(tmp_path), Options(halo_m=10))[0]


@pytest.mark.parametrize(("cell", "shift"), [(1.0, 0.3), (0.8, 0.0), (0.4, 0.1), (2.0, 0.5)])
def test_load_border_resamples_as_for_the_tile(tmp_path, cell, shift):
    """A cell's height must not depend on the window that is read: a border's reaches beyond the tile's."""
    heights = 200 + np.random.default_rng(0).normal(size=(int(500 / cell),) * 2).astype(np.float32)
    write(tmp_path / "dsm.tif", np.full((500, 500), 200, np.float32), 500000, 5600500)
    write(tmp_path / "dtm.tif", heights, 500000 + shift, 5600500 + shift, cell=cell)
    place = rasters.index(tmp_path, {"dsm": "dsm.tif", "dtm": "dtm.tif"}, tile_size_m=250).tiles[0]
    whole = load(place, Options(halo_m=20))
    for border in border_of(place.grid, 30):
        around = load_border(place.around(border.grid, border.within(200)), place.grid, Options())
        west, south = (max(whole.grid.bounds[k], around.grid.bounds[k]) for k in (0, 1))
        east, north = (min(whole.grid.bounds[k], around.grid.bounds[k]) for k in (2, 3))
        common = Grid(UTM, west, north, 1.0, int(east - west), int(north - south))
        ours, theirs = (data.dtm[data.grid.window(common)] for data in (whole, around))
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-9)
        assert np.isfinite(ours).any()


@pytest.mark.parametrize("nodata", [None, -9999.0])
@pytest.mark.parametrize("cell", [0.25, 0.1, 0.04])
def test_load_fine_file_is_read_with_few_cells_in_one(tmp_path, cell, nodata):
    """The mean of a plane with noise, the same from two windows; a file has no whole number of steps."""
    count = int(61.5 / cell)
    steps = (np.arange(count) + 0.5) * cell
    heights = 200 + 0.05 * steps - 0.03 * steps[:, None]
    heights += np.random.default_rng(0).normal(0, 0.1, heights.shape)
    void = slice(round(20 / cell), round(30 / cell))
    if nodata is not None:
        heights[void, void] = nodata
    write(tmp_path / "fine.tif", heights.astype(np.float32), 500000, 5600100, cell=cell, nodata=nodata)
    grids = Grid(UTM, 500000.0, 5600100.0, 1.0, 61, 61), Grid(UTM, 500007.0, 5600081.0, 1.0, 40, 40)
    loaded = []
    for grid in grids:
        patch = read_window(tmp_path / "fine.tif", "dsm fine.tif", grid, grid, None, heights=True)
        assert grid.width * 2 <= patch.values.shape[1] <= grid.width * 4 + 8
        assert misalignment(patch.file_lattice, grid) == f"its cells are {cell:g} m, the tile's 1 m"
        loaded.append(resample_to(patch, grid, Resampling.bilinear))
    whole, part = loaded
    np.testing.assert_allclose(whole[19:59, 7:47], part, rtol=0, atol=1e-9)
    east, north = np.meshgrid(grids[0].eastings - 500000, 5600100 - grids[0].northings)
    off = whole - (200 + 0.05 * east - 0.03 * north)
    assert np.nanstd(off) < 0.1 * cell
    assert abs(np.nanmean(off)) < 0.01
    assert np.isnan(whole).sum() == (100 if nodata is not None else 0)


def test_load_fine_mask_takes_most_frequent_class(tmp_path):
    classes = np.kron(np.random.default_rng(0).integers(0, 5, (20, 20)), np.ones((8, 8))).astype(np.uint8)
    write(tmp_path / "mask.tif", classes, 500000, 5600100, cell=0.125)
    grid = Grid(UTM, 500000.0, 5600100.0, 1.0, 20, 20)
    patch = read_window(tmp_path / "mask.tif", "mask", grid, grid, None)
    assert patch.step == 4
    np.testing.assert_array_equal(resample_to(patch, grid, Resampling.nearest), classes[::8, ::8])


def test_load_tile_of_too_many_cells_fails_before_reading(tmp_path, models):
    huge = Grid(UTM, 295500.0, 5629480.0, 1.0, 30_000, 30_000)
    with pytest.raises(TaskError, match=r"30000 x 30000 cells with its halo, more than 25,000,000; catalog"):
        load(tile(tmp_path, grid=huge), Options())


@pytest.mark.parametrize(
    ("chosen", "has_layer", "is_read"),
    [("dsm", True, False), ("auto", True, True), ("auto", False, False), ("layer", True, True)],
)
def test_load_road_height_is_read_as_asked(tmp_path, models, chosen, has_layer, is_read):
    heights = relief(seed=2)
    write(tmp_path / "road_height.tif", heights, **NORTH)
    place = tile(tmp_path, road_height="road_height.tif" if has_layer else None)
    for data in (
        load(place, Options(road_height=chosen)),
        load_border(place, GRID, Options(road_height=chosen)),
    ):
        assert not data.offset_dsm
        assert (data.road_height is not None) == is_read
        if is_read:
            np.testing.assert_array_equal(data.road_height, heights)
    assert load_border(place, GRID, Options()).road_height is None


@pytest.mark.parametrize(
    ("dates", "crs", "undeclared", "is_used", "note"),
    [
        (("2020-04-01", "2020-04-01"), "EPSG:25832+7837", False, True, None),
        (("2020-04-01", "2020-04-02"), "EPSG:25832+7837", True, False, "differs in date: dsm 2020-04-01"),
        (("2020-04-01", "2020-04-01"), UTM, False, False, "do not declare vertical CRS; set load.offset_und"),
        (("2020-04-01", "2020-04-01"), UTM, True, True, None),
    ],
)
def test_load_offset_needs_one_survey(tmp_path, dates, crs, undeclared, is_used, note):
    for name, date in zip(("dsm", "dtm"), dates, strict=True):
        write(tmp_path / f"{name}.tif", relief(), **NORTH, crs=crs, tags={"ACQUISITIONDATE": date})
    options = Options(road_height="offset", offset_undeclared=undeclared)
    data = load(tile(tmp_path), options)
    assert data.offset_dsm == load_border(tile(tmp_path), GRID, options).offset_dsm == is_used
    assert len(data.notes) == (note is not None)
    assert note is None or note in data.notes[0]
