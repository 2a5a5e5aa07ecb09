"""The public library, `import flexroad`, as used in a notebook."""

import contextlib
import doctest
import importlib
import io
import re
import shlex
import subprocess
import sys
from pathlib import Path

import geopandas
import numpy as np
import pytest
import rasterio
import rioxarray
import shapely
import trimesh
import xarray as xr

import flexroad
from flexroad.catalog import Catalog
from flexroad.pipeline.config.loading import load_config
from flexroad.pipeline.execute import SerialExecutor
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.run.runner import run_tiles
from flexroad.tools.synthetic.scenes import write_scenes

ROOT = Path(__file__).parents[2]
MODULES = [
    "flexroad",
    "flexroad.tools.synthetic.example",
    "flexroad.tools.results.process",
    "flexroad.tools.results.run",
    "flexroad.tools.results.surface",
]
CENTRE = 500210.0, 5600030.0


@pytest.fixture(scope="module")
def city(tmp_path_factory) -> Path:
    """A folder with a survey of two tiles of 60 m and ``runs/city``, in which the first tile is done."""
    folder = tmp_path_factory.mktemp("library")
    catalog = Catalog.read(write_scenes(folder / "survey", 2, seed=0, size_m=60))
    run = Run.create(folder / "runs" / "city", load_config("production"), catalog)
    run_tiles(run, SerialExecutor(), only=lambda tile: tile == catalog.tiles[0])
    return folder


@pytest.fixture(scope="module")
def rasters(city) -> dict[str, xr.DataArray]:
    """The rasters of the first tile by layer."""
    return {
        layer: rioxarray.open_rasterio(city / "survey" / layer / "499980_5599980.tif")
        for layer in ("dsm", "dtm", "road_mask")
    }


@pytest.fixture(scope="module")
def scene() -> xr.Dataset:
    return flexroad.example(size_m=60)


@pytest.fixture(scope="module")
def surface(scene) -> flexroad.Surface:
    return flexroad.fit(scene.dsm, scene.dtm, scene.road_mask)


@pytest.mark.parametrize("name", MODULES)
def test_docstring_examples_run(name, city, monkeypatch):
    monkeypatch.chdir(city)
    failed, tried = doctest.testmod(importlib.import_module(name))
    assert not failed
    assert tried


def test_public_methods_have_examples():
    for owner in (flexroad.Surface, flexroad.RunView):
        members = {name: member for name, member in vars(owner).items() if name[0] != "_" and member.__doc__}
        for name, member in members.items():
            if callable(member) or isinstance(member, property):
                assert ">>> " in member.__doc__, f"{owner.__name__}.{name}"


def test_docs_library_page_runs(city, tmp_path, monkeypatch, flexroad):
    monkeypatch.chdir(tmp_path)
    page = (ROOT / "docs" / "library.md").read_text()
    names: dict[str, object] = {}
    blocks = re.findall(r"```(console|python)\n(.*?)```", page, flags=re.DOTALL)
    assert len(blocks) > 4
    for kind, block in blocks:
        if kind == "python":
            with contextlib.redirect_stdout(io.StringIO()):
                exec(compile(block, "library.md", "exec"), names)
            continue
        for line in block.splitlines():
            command, *words = shlex.split(line.removeprefix("$ "))
            assert command == "flexroad"
            assert flexroad(*words).code == 0, line
    assert {"road.npz", "road.glb", "height.tif", "height.png"} <= {path.name for path in tmp_path.iterdir()}


LOADED = "; print([name for name in '{}'.split() if name in sys.modules])"
HEAVY = {
    "import sys, flexroad; dir(flexroad)": "numpy numba scipy rasterio pandas xarray torch dask pydantic",
    "import sys; from flexroad.pipeline.config import loading; loading.load_config('production')": (
        "numba pandas xarray torch dask scipy.ndimage scipy.sparse scipy.spatial scipy.special"
    ),
}
SAME = "import os, numba; a = dict(os.environ); import flexroad; flexroad.fit; print(a == dict(os.environ))"
CODES = [*((code + LOADED.format(names), "[]") for code, names in HEAVY.items()), (SAME, "True")]


@pytest.mark.parametrize(("code", "expected"), CODES, ids=["import", "configuration", "environment"])
def test_import_loads_no_heavy_library_and_changes_no_environment(code, expected):
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=True)
    assert done.stdout.strip() == expected


def test_public_names_exist():
    assert set(flexroad.__all__) <= set(dir(flexroad))
    assert all(hasattr(flexroad, name) for name in flexroad.__all__)
    assert not hasattr(flexroad, "unknown")


def run_of_one(folder, change=lambda survey: None) -> flexroad.RunView:
    """Run production over one tile: with neighbours the run would know more ground than its rasters."""
    catalog = Catalog.read(write_scenes(folder / "survey", 1, seed=0, size_m=60))
    change(folder / "survey")
    run_tiles(Run.create(folder / "run", load_config("production"), catalog), SerialExecutor())
    return flexroad.open_run(folder / "run")


def places(bounds):
    return np.random.default_rng(0).uniform(bounds[:2], bounds[2:], (500, 2)).T


def test_fit_equals_run_over_same_rasters(tmp_path, rasters):
    fitted, run = flexroad.fit(**rasters), run_of_one(tmp_path)
    x, y = places(fitted.bounds)
    np.testing.assert_allclose(fitted.height(x, y), run.height(x, y), rtol=0, atol=1e-9)
    np.testing.assert_allclose(fitted.normal(x, y), run.normal(x, y), rtol=0, atol=1e-9)
    kept = fitted.clusters.mask[50:-50, 50:-50]
    np.testing.assert_array_equal(kept, run.tile("499980_5599980").road_filtered)
    products = tmp_path / "run" / "tiles" / "499980_5599980"
    stored = flexroad.open_surface(products / "499980_5599980_flexroad_surface.npz")
    np.testing.assert_allclose(stored.height(x, y), fitted.height(x, y), rtol=0, atol=1e-9)
    with pytest.raises(flexroad.ConfigError, match="no road mask"):
        stored.to_mesh()
    mesh = trimesh.load(products / "499980_5599980_flexroad.glb")
    assert sum(len(part.faces) for part in mesh.geometry.values()) == len(fitted.to_mesh().faces)


def test_fit_without_road_equals_run_and_is_flagged(tmp_path, rasters):
    def remove_roads(survey):
        for layer in ("road_mask", "reference_road"):
            with rasterio.open(survey / layer / "499980_5599980.tif", "r+") as file:
                file.write(np.zeros((1, *file.shape), file.dtypes[0]))

    run = run_of_one(tmp_path, remove_roads)
    assert run.metrics["flags"].item() == "no-road"
    with pytest.warns(UserWarning, match="road_mask has no road cell .* the surface is the terrain's"):
        fitted = flexroad.fit(rasters["dsm"], rasters["dtm"], rasters["road_mask"] * 0)
    assert fitted.flags == ("no-road",)
    assert "road: 0 cells given, 0 kept by the filter; no-road" in repr(fitted)
    x, y = places(fitted.bounds)
    np.testing.assert_allclose(fitted.height(x, y), run.height(x, y), rtol=0, atol=1e-9)
    assert not fitted.to_mesh().face_attributes["road"].any()
    fitted.save(tmp_path / "terrain.npz")
    assert flexroad.open_surface(tmp_path / "terrain.npz").flags == ("no-road",)


def classes(scene) -> xr.DataArray:
    """Land cover: roads 1, houses 2."""
    return xr.where(scene.road_mask, 1, 2).rio.write_crs(scene.rio.crs)


def land_cover(scene):
    """A comparison is a mask of bool with the nodata of the land cover, 255, as an attribute."""
    with xr.set_options(keep_attrs=True):
        mask = scene.road_mask.astype("uint8").rio.write_nodata(255) == 1
    assert mask.dtype == bool
    return {**scene, "road_mask": mask}


def reversed_axes(scene):
    turned = scene.isel(y=slice(None, None, -1), x=slice(None, None, -1)).transpose("x", "y")
    return {**scene, "dsm": turned.dsm, "road_mask": turned.road_mask.astype("uint8").expand_dims("band")}


def transform_only(scene):
    return dict(scene.rio.write_transform().drop_vars(["x", "y"]))


@pytest.mark.parametrize(
    "form",
    [
        lambda scene: {**scene, "road_mask": classes(scene), "road_values": [1]},
        land_cover,
        reversed_axes,
        transform_only,
    ],
    ids=["road_values", "land cover", "reversed axes", "transform only"],
)
def test_fit_of_the_same_ground_in_another_form_is_equal(scene, surface, form):
    arrays = form(scene)
    names = ("dsm", "dtm", "road_mask", "road_values")
    fitted = flexroad.fit(**{name: arrays[name] for name in names if name in arrays})
    np.testing.assert_array_equal(fitted.fitted.A, surface.fitted.A)
    np.testing.assert_array_equal(fitted.road.mask, surface.road.mask)
    assert fitted.road.core == surface.road.core


@pytest.mark.parametrize(
    ("change", "values", "message"),
    [
        (
            classes,
            (),
            "road_mask: values are 1, 2, and all but 0 count as road; name the",
        ),
        (classes, (7,), "road_mask: no cell has road_values 7 but 1, 2"),
        (lambda scene: scene.road_mask | True, (), "road_mask: every cell counts as road, with the value 1"),
    ],
    ids=["classes", "another value", "all road"],
)
def test_fit_mask_that_is_no_mask_of_roads_warns(scene, change, values, message):
    with pytest.warns(UserWarning, match=message):
        flexroad.fit(scene.dsm, scene.dtm, change(scene).rio.write_crs(25832), road_values=values)


def test_fit_settings_are_used_and_named(scene):
    fitted = flexroad.fit(scene.dsm, scene.dtm, scene.road_mask, settings={"fit": {"spacing_m": 10}})
    assert fitted.fitted.A.shape == (9, 9)
    assert "config production --set fit={spacing_m: 10}>" in repr(fitted)
    with pytest.raises(flexroad.ConfigError, match="fit.spacing: unknown key; did you mean spacing_m"):
        flexroad.fit(scene.dsm, scene.dtm, scene.road_mask, settings={"fit.spacing": 10})


@pytest.fixture(scope="module")
def streets() -> geopandas.GeoDataFrame:
    """A street across the scene by its centre line, and a footway that does not count."""
    lines = shapely.linestrings(
        [[(500180, 5600010), (500280, 5600050)], [(500180, 5600040), (500280, 5600040)]]
    )
    table = {"highway": ["residential", "footway"], "width": ["8", "3"]}
    return geopandas.GeoDataFrame(table, geometry=lines, crs="EPSG:25832")


def test_fit_table_of_roads_equals_run_over_same_file(tmp_path, rasters, streets):
    for name in ("dsm", "dtm"):
        rasters[name].rio.to_raster(tmp_path / f"{name}.tif")
    streets = streets.set_geometry(streets.translate(-220, -20))
    streets.to_file(tmp_path / "roads.gpkg")
    layers = {"dsm": "dsm.tif", "dtm": "dtm.tif", "roads": "roads.gpkg"}
    catalog = flexroad.catalog_from(tmp_path, tmp_path / "c.parquet", tile_size_m=60, **layers)
    run = flexroad.run(catalog, "production_vector", out=tmp_path / "run", workers=1)
    for config in ("production", "production_vector"):
        fitted = flexroad.fit(rasters["dsm"], rasters["dtm"], streets, config)
        x, y = places(fitted.bounds)
        np.testing.assert_allclose(fitted.height(x, y), run.height(x, y), rtol=0, atol=1e-9)
    # A street of 8 m across 60 m.
    assert fitted.road.mask[50:-50, 50:-50].sum() == pytest.approx(8 * 60 * np.hypot(10, 4) / 10, rel=0.03)
    fitted.save(tmp_path / "road.npz")
    again = flexroad.open_surface(tmp_path / "road.npz").to_mesh()
    np.testing.assert_array_equal(again.faces, fitted.to_mesh().faces)


LEVELS = {"segment": {"method": "vector", "levels": True}}


@pytest.mark.parametrize(
    ("change", "options", "message"),
    [
        (lambda roads: roads.set_crs(None, allow_override=True), {}, "the roads have no CRS"),
        (lambda roads: roads.assign(WIDTH=8), {}, "cannot be written as a GeoPack"),
        (lambda roads: roads, {"road_values": [1]}, "road_values are of a mask"),
        (lambda roads: roads, {"settings": LEVELS}, "segment.levels gives several surfaces"),
    ],
    ids=["no CRS", "equal columns", "road_values", "levels"],
)
def test_fit_unusable_table_of_roads_raises(scene, streets, change, options, message):
    error = flexroad.ConfigError if options else flexroad.TaskError
    with pytest.raises(error, match=message):
        flexroad.fit(scene.dsm, scene.dtm, change(streets), **options)


def test_fit_whose_road_the_filter_drops_or_that_has_none_is_flagged(scene, surface, streets):
    assert surface.flags == ()
    # Less than the smallest area that the filter keeps.
    speck = scene.road_mask & (scene.road_mask.cumsum("x").cumsum("y") <= 5)
    assert 0 < speck.sum() <= 25
    assert flexroad.fit(scene.dsm, scene.dtm, speck).flags == ("no-road",)
    with pytest.warns(UserWarning, match="no road of roads.gpkg lies on this tile"):
        fitted = flexroad.fit(scene.dsm, scene.dtm, streets.translate(1000).to_frame("geometry"))
    assert fitted.flags == ("no-road",)


def test_fit_dask_arrays_with_nodata_equals_nan(scene, surface):
    with_nodata = scene.dsm.where(scene.x > 500202, -9999.0).rio.write_nodata(-9999.0).chunk(20)
    lazy = flexroad.fit(with_nodata, scene.dtm, scene.road_mask)
    missing = flexroad.fit(scene.dsm.where(scene.x > 500202), scene.dtm, scene.road_mask)
    assert lazy.height(*CENTRE) == missing.height(*CENTRE)


def test_fit_dtm_on_other_grid_is_resampled_with_warning(scene, surface):
    wider = flexroad.example(size_m=80)
    assert (
        flexroad.fit(scene.dsm, wider.dtm.sel(y=scene.y, x=scene.x), scene.road_mask).bounds == surface.bounds
    )
    with pytest.warns(
        UserWarning, match=r"dtm resampled to the grid of the dsm: its cells are 2 m, the dsm's 1"
    ):
        coarse = flexroad.fit(scene.dsm, scene.dtm.coarsen(x=2, y=2).mean(), scene.road_mask)
    assert abs(coarse.height(*CENTRE) - surface.height(*CENTRE)) < 0.1


def rotated(array):
    from affine import Affine

    transform = Affine.translation(500200, 5600060) @ Affine.rotation(10) @ Affine.scale(1, -1)
    return array.drop_vars(["x", "y"]).rio.write_transform(transform)


@pytest.mark.parametrize(
    ("layer", "change", "message"),
    [
        ("dsm", lambda a: a.drop_vars("spatial_ref"), "dsm has no CRS; write it"),
        ("dtm", lambda a: a.rio.write_crs(4326), "dtm is in EPSG:4326, a geographic CRS in degrees"),
        ("dsm", lambda a: a.rio.write_crs(2264), "dsm is in EPSG:2264, whose coordinates are in US"),
        ("dsm", lambda a: a.rio.write_crs(3857), "dsm: a metre of EPSG:3857 is 0.708 m on the ground"),
        ("dsm", lambda a: a.rio.write_crs("EPSG:25832+6360"), "heights in US survey foot; multiply"),
        ("dtm", lambda a: a.assign_attrs(units="ft"), "dtm has heights in ft; multiply it by 0.3048 and set"),
        ("dtm", lambda a: a.assign_attrs(units="K"), "dtm has units 'K'; give metres"),
        ("dsm", rotated, "dsm is rotated; turn it north up"),
        ("dsm", lambda a: a.assign_coords(y=5600060 - 2 * np.arange(60.0)), "dsm has pixels of 1 x 2 m"),
        ("dsm", lambda a: a.assign_coords(x=500200 + np.arange(60.0) ** 2), "dsm has x in steps of 1 to 117"),
        ("dtm", lambda a: a.rio.write_crs(25833), "dtm is in EPSG:25833, the dsm in EPSG:25832"),
        ("dtm", lambda a: a.assign_coords(x=a.x + 5000), "dtm .* does not overlap the dsm"),
        ("dsm", lambda a: a.where(a.x < 500206), "dsm has 10.0% valid cells, below 25%"),
        ("dtm", lambda a: a * np.nan, "dtm has only nodata"),
        ("dsm", lambda a: a * 100, r"dsm: all 3600 heights .* outside -500 to 9000 m \(15\d+ to 17\d+\); if"
         " they are in cm or mm, divide them by 100 or 1000$"),
        ("dtm", lambda a: a * 0 - 9999, r"dtm has no height in -500 to 9000 m \(-9999 to -9999\); give"),
        ("dsm", lambda a: a.to_dataset(), "dsm is a Dataset; give an xarray.DataArray"),
        ("dsm", lambda a: xr.concat([a, a], "time"), r"dsm has dimensions \(time: 2, y: 60, x: 60\)"),
        ("dsm", lambda a: a.assign_attrs(units="m", scale_factor=0.01), "scale_factor 0.01"),
        ("road_mask", lambda a: a * 0.6 + 0.2, "road_mask: values are 0.2, 0.8, as of probabilities"),
        ("road_mask", lambda a: a.astype(str), "road_mask has <U5, not numbers"),
        ("dsm", lambda a: a[:1], "dsm has 1 x 60 cells; give at least 2 x 2"),
    ],
)  # fmt: skip
def test_fit_unusable_array_raises_one_line(scene, layer, change, message):
    plain = {name: scene[name].copy() for name in ("dsm", "dtm", "road_mask")}
    for array in plain.values():
        array.attrs = {}
    with pytest.raises(flexroad.TaskError, match=message) as error:
        flexroad.fit(**{**plain, layer: change(plain[layer])})
    assert "\n" not in str(error.value)


def test_unknown_configuration_variant_or_size_raises(scene):
    with pytest.raises(flexroad.ConfigError, match="size_m 10: give"):
        flexroad.example(size_m=10)
    with pytest.raises(flexroad.ConfigError, match="did you mean production"):
        flexroad.fit(scene.dsm, scene.dtm, scene.road_mask, config="productio")
    with pytest.raises(flexroad.ConfigError, match="no variant 'plane'"):
        flexroad.fit(scene.dsm, scene.dtm, scene.road_mask, variant="plane")


def test_surface_to_xarray_has_height_and_road(surface):
    raster = surface.to_xarray()
    assert raster.rio.crs.to_epsg() == 25832
    assert tuple(raster.rio.bounds()) == surface.bounds
    assert raster.y[0] > raster.y[-1]
    x, y = np.meshgrid(raster.x, raster.y)
    np.testing.assert_allclose(raster.height, surface.height(x, y), rtol=0, atol=1e-9)
    assert raster.road.sum() == surface.clusters.mask.sum()
    assert np.isnan(raster.height.rio.nodata)
    assert "_FillValue" not in raster.height.attrs  # xarray refuses to write such an attribute
    odd = surface.to_xarray(0.7)
    assert np.isfinite(odd.height.sel(x=slice(None, 500260), y=slice(None, 5600000))).all()
    with pytest.raises(flexroad.ConfigError, match="resolution 0 m"):
        surface.to_xarray(0)


def test_surface_saved_and_opened_is_equal(surface, tmp_path):
    surface.save(tmp_path / "road.npz")
    again = flexroad.open_surface(tmp_path / "road.npz")
    assert repr(again) == repr(surface)
    assert again.to_xarray().identical(surface.to_xarray())
    assert np.array_equal(again.to_mesh().vertices, surface.to_mesh().vertices)
    (tmp_path / "road.npz").write_bytes(b"nothing")
    with pytest.raises(flexroad.TaskError, match="not a FlexRoad surface"):
        flexroad.open_surface(tmp_path / "road.npz")


def test_fit_plane_and_raster_have_heights_but_no_file(scene, tmp_path):
    for variant, kind in (("plane", "plane"), ("rgt", "raster")):
        flat = flexroad.fit(scene.dsm, scene.dtm, scene.road_mask, "ablation", variant)
        assert repr(flat).startswith(f"<flexroad.Surface: {kind}, config ablation>")
        assert np.isfinite(flat.height(*CENTRE))
        with pytest.raises(flexroad.TaskError, match="not a NURBS surface"):
            flat.save(tmp_path / "flat.npz")


def test_surface_to_mesh_has_surface_heights(surface):
    mesh = surface.to_mesh()
    east, north, up = (mesh.vertices + mesh.metadata["origin"]).T
    # Near the road the mesh leaves out the steps of the ground beside it.
    off = np.minimum(*(np.abs(up - z(east, north)) for z in (surface.height, surface.fitted.smooth)))
    assert off.max() < 1e-6
    assert mesh.face_attributes["road"].any()
    upright = surface.to_mesh(up="y")
    np.testing.assert_array_equal(upright.vertices[:, 1], mesh.vertices[:, 2])
    assert (upright.face_normals[:, 1] > 0).all()


def test_run_to_xarray_is_lazy_and_equals_heights(city, tmp_path):
    run = flexroad.open_run(city / "runs" / "city")
    raster = run.to_xarray()
    assert raster.height.chunks == ((60,), (60, 60))
    assert raster.height.dtype == np.float32
    raster.height.rio.to_raster(tmp_path / "height.tif")
    with rasterio.open(tmp_path / "height.tif") as file:
        assert np.isnan(file.nodata)
    done, pending = raster.isel(x=slice(0, 60)), raster.isel(x=slice(60, None))
    x, y = np.meshgrid(done.x, done.y)
    np.testing.assert_allclose(done.height, run.height(x, y), rtol=0, atol=1e-4)
    assert pending.height.isnull().all()
    assert not pending.road.any()
    assert done.road.any()
    inner = run.to_xarray((499990.2, 5599990.7, 500000.0, 5600000.0))
    assert inner.height.equals(raster.height.sel(x=inner.x, y=inner.y))
    assert tuple(inner.rio.bounds()) == (499990, 5599990, 500000, 5600000)
    beyond = run.to_xarray((499970, 5599970, 499990, 5599990))
    assert int(beyond.height.notnull().sum()) == 100
    with pytest.raises(flexroad.ConfigError, match="are empty"):
        run.to_xarray((1, 1, 0, 0))


def test_run_to_xarray_without_geotiffs_raises(city, tmp_path):
    catalog = Catalog.read(city / "survey" / "catalog.parquet")
    run = Run.create(tmp_path / "run", load_config("production", ["export.formats=[npz]"]), catalog)
    with pytest.raises(flexroad.ConfigError, match="exports no GeoTIFF of flexroad"):
        flexroad.open_run(run.path).to_xarray()


def test_run_with_failed_tile_lists_failures(city, tmp_path):
    catalog = Catalog.read(write_scenes(tmp_path / "survey", 1, seed=0, size_m=60))
    (tmp_path / "survey" / "dsm" / "499980_5599980.tif").unlink()
    run = Run.create(tmp_path / "run", load_config("production"), catalog)
    with pytest.raises(flexroad.ConfigError, match=r"failures.csv does not exist"):
        assert flexroad.open_run(run.path).failures
    run_tiles(run, SerialExecutor())
    view = flexroad.open_run(run.path)
    assert view.failures[["tile_id", "stage"]].values.tolist() == [["499980_5599980", "load"]]
    assert view.tiles.state.tolist() == ["failed"]
    assert np.isnan(view.height(500010, 5600030))
    assert np.isnan(view.normal([0, 1], 0)).all()
    with pytest.raises(flexroad.ConfigError, match="is no run"):
        flexroad.open_run(tmp_path)
    with pytest.raises(flexroad.ConfigError, match="no variant 'x'"):
        flexroad.open_run(run.path, "x")
