"""Meshes of runs are checked: meshes of all variants have no fault. A mesh with a fault fails its tile."""

import zipfile
from dataclasses import replace

import pytest

from flexroad.catalog import Catalog
from flexroad.catalog.sources import rasters
from flexroad.pipeline.config.loading import compose, load_config
from flexroad.pipeline.execute import SerialExecutor
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.run.runner import run_tiles
from flexroad.pipeline.store.tables import read_metrics
from flexroad.tasks import sample
from flexroad.tools.report.browser.page import html_page
from flexroad.tools.report.content import MESHES, gather
from flexroad.tools.report.pages import markdown_page

SPLINE = {"load": {"halo_m": 50}, "fit": {"method": "smoothing_spline", "spacing_m": 20}}
VARIANTS = {
    "plane": {"fit": "plane", "sample": "corners"},
    "rgt": {"fit": "raster", "sample": "uniform"},
    "flexroad": {},
    "filtered": {"sample": {"mask": "filtered"}},
    "uneven": {"sample": {"road_m": 0.7, "terrain_m": 3.3}},
    "halo": {"load": {"halo_m": 20}},
    "production": SPLINE,
    "production_uniform": {**SPLINE, "sample": "uniform"},
    "production_uneven": {**SPLINE, "sample": {"road_m": 0.7, "terrain_m": 3.3}},
}
EVERY = {
    "fit": {"method": "nurbs", "control_points": [8, 8], "iterations": 2},
    "variants": VARIANTS,
}
"""All fits and sampling methods; the fits are quick and inaccurate, which changes no plan coordinate."""


def checks(run):
    return gather(run).tables[MESHES][0].set_index("method")


@pytest.fixture
def real_tiles(real_data, tmp_path) -> Catalog:
    """Four tiles of two cities; the surveys end within three of them."""
    tiles = []
    for archive, names in (
        ("London_BNG", ("dsm_barb*.tif", "dem_barb*.tif", "landcover*.tif")),
        ("Goteborg_SWEREF99_1200", ("DSM_KRbig.tif", "DEM_KRbig.tif", "landcover.tif")),
    ):
        zipfile.ZipFile(real_data / "umep" / f"{archive}.zip").extractall(tmp_path)
        layers = dict(zip(("dsm", "dtm", "road_mask"), names, strict=True))
        tiles += rasters.index(tmp_path / archive, layers, road_values=(1,)).tiles
    Catalog(tuple(tiles[number] for number in (2, 4, 5, 9))).write(tmp_path / "real.parquet")
    return Catalog.read(tmp_path / "real.parquet")


@pytest.mark.slow
@pytest.mark.parametrize("source", ["made_survey", pytest.param("real_tiles", marks=pytest.mark.real)])
def test_meshes_of_all_variants_have_no_fault(source, request, tmp_path):
    found = request.getfixturevalue(source)
    made = source == "made_survey"
    catalog = Catalog(Catalog.read(found / "catalog.parquet").tiles[:2]) if made else found
    run = Run.create(tmp_path / "run", compose(EVERY, "every"), catalog)
    assert run_tiles(run, SerialExecutor()).done == len(catalog.tiles)
    table = checks(run)
    assert list(table.index) == list(VARIANTS)
    assert set(table.meshes) == {len(catalog.tiles)}
    assert set(table.result) == {"no fault"}
    if made:
        assert table.faces["rgt"] == 2 * 2 * 59**2


@pytest.mark.slow
def test_mesh_with_fault_fails_its_tile_with_one_line(survey, quick_config, tmp_path, monkeypatch):
    run = Run.create(tmp_path / "run", load_config(quick_config), Catalog.read(survey))
    first = run.catalog.tiles[0]
    sampled = sample.sample

    def broken(surface, road, *arguments, **named):
        mesh = sampled(surface, road, *arguments, **named)
        if road.core != first.grid or len(mesh.faces) == 2:
            return mesh
        faces = mesh.faces.copy()
        faces[[3, 8]] = faces[[3, 8], ::-1]
        return replace(mesh, faces=faces)

    monkeypatch.setattr(sample, "sample", broken)
    summary = run_tiles(run, SerialExecutor())
    assert (summary.done, summary.failed) == (3, 1)
    notices = [failure.notice for failure in summary.failures]
    assert len(notices) == 2
    for notice in notices:
        assert notice.startswith(
            f"{first.id}: evaluate: MeshFault: the mesh has 2 inverted faces (the first at "
        )
    assert not list(run.folder(first.id).path.glob("*.glb"))
    rows = read_metrics(run.path).set_index(["tile_id", "variant"])
    assert list(rows.status[first.id]) == ["done", "failed", "failed"]
    table = checks(run)
    assert list(table["meshes with faults"]) == [0, 1, 1]
    assert list(table.meshes) == [4, 4, 4]
    assert "| rgt | 4 | 20,886 | 1 | error: 1 of 4 meshes have faults |" in markdown_page(gather(run))
    assert "error: 1 of 4 meshes have faults" in html_page(run, gather(run))
    monkeypatch.undo()
    assert run_tiles(run, SerialExecutor(), force=frozenset({"sample"})).done == 4
    assert set(checks(run).result) == {"no fault"}
