"""The figures show the numbers of the run."""

import io
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
import rasterio
from matplotlib import colormaps
from PIL import Image

from flexroad.catalog import Grid
from flexroad.catalog.errors import CatalogError
from flexroad.pipeline.config.loading import compose, load_config
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.store.tables import read_metrics
from flexroad.tools.reproduce import figures, tile_figures, tile_view
from flexroad.tools.reproduce.layout import DPI, SMALL_PX
from flexroad.tools.reproduce.metrics_data import collect
from tests.builders import finish_run

pytestmark = pytest.mark.slow

FIGURE_NAMES = ("road_profile", "error_and_smoothness", "ablation_renders", "trade_off", "dataset")
BASE = {"fit": {"method": "nurbs", "control_points": [10, 10], "iterations": 30}}
ABLATION = {
    **BASE,
    "variants": {
        "flat": {"fit": "plane", "sample": "corners"},
        "cells": {"fit": "raster", "sample": "uniform"},
        "flexroad": {},
        "bare": {"ecsrc": "off"},
        "mixed": {"fit": {"method": "raster", "terrain": "dtm"}, "sample": "uniform"},
        "fine": {"fit": {"control_points": [14, 14]}},
        "coarse": {"fit": {"control_points": [8, 8]}},
        "quadratic": {"fit": {"degree": 2}},
        "sparse": {"sample": {"road_m": 2, "terrain_m": 20}},
        "two_things": {"fit": {"degree": 2, "control_points": [8, 8]}},
    },
}
ROLES = {"full": "flexroad", "plane": "flat", "rgt": "cells", "wo_nurbs": "mixed", "wo_ecsrc": "bare"}


@pytest.fixture(scope="module")
def run(made_survey, tmp_path_factory) -> Run:
    return finish_run(tmp_path_factory.mktemp("figures") / "run", made_survey, compose(ABLATION, "quick"))


@pytest.fixture(scope="module")
def rows(run) -> pd.DataFrame:
    return read_metrics(run.path)


@pytest.fixture(scope="module")
def tile(run, rows) -> tile_view.TileView:
    return tile_view.read_tile_view(run, tile_view.typical_tile(rows, "flexroad"), ROLES)


def row_of(rows, tile, variant):
    return rows[(rows.tile_id == tile.tile_id) & (rows.variant == variant)].iloc[0]


def test_roles_of_renamed_variants_follow_from_options(run):
    assert tile_view.roles_of(run.config) == ROLES


def test_roles_of_shipped_configurations_are_complete():
    assert tile_view.roles_of(load_config("paper")) == {"full": "flexroad", "plane": "plane", "rgt": "rgt"}
    ablation = tile_view.roles_of(load_config("ablation"))
    assert ablation == {role: role for role in ROLES} | {"full": "flexroad"}


def test_typical_tile_is_median_of_tiles_with_road():
    table = pd.DataFrame(
        {"tile_id": list("abcde"), "variant": "v", "l2_road_m": [0.5, 0.1, np.nan, 0.2, 0.3]}
    )
    assert tile_view.typical_tile(table, "v") == "d"
    with pytest.raises(ConfigError, match="--tile"):
        tile_view.typical_tile(table[table.tile_id == "c"], "v")


def test_maps_show_values_of_metrics_table(run, rows, tile, made_survey):
    columns = {"Plane": "plane", "RGT": "rgt", "FlexRoad": "full"}
    figure = tile_figures.draw_maps(tile, columns)
    axes = np.array(figure.axes[:6]).reshape(2, 3)
    for (upper, lower), (label, role) in zip(axes.T, columns.items(), strict=True):
        row = row_of(rows, tile, ROLES[role])
        error = upper.images[0].get_array()
        np.testing.assert_allclose(error[tile.street].mean(), row.l2_road_m, rtol=1e-9)
        np.testing.assert_allclose(error[~tile.street].mean(), row.l2_terrain_m, rtol=1e-9)
        angles = lower.collections[0].get_array()
        assert len(angles) == row.triangles
        mesh = tile.results[role].mesh
        centroids = mesh.vertices[mesh.faces].mean(axis=1) + mesh.origin
        on_road = tile.street[tile.grid.cells(centroids[:, 0], centroids[:, 1])]
        if on_road.any() and not on_road.all():
            np.testing.assert_allclose(angles[on_road].mean(), row.mad_road_deg, rtol=1e-6, atol=1e-8)
            np.testing.assert_allclose(angles[~on_road].mean(), row.mad_terrain_deg, rtol=1e-6, atol=1e-8)
        assert upper.get_title() == f"{label}\nroad {row.l2_road_m:.3f} m, terrain {row.l2_terrain_m:.3f} m"
        assert lower.get_title() == f"road {row.mad_road_deg:.2f}°, terrain {row.mad_terrain_deg:.2f}°"


def test_along_is_bilinear_and_nan_next_to_nan():
    rows, cols = np.mgrid[:6, :7]
    at = np.array([0.25, 2.5, 4.75]), np.array([5.5, 0.0, 3.2])
    np.testing.assert_allclose(tile_figures.along(3.0 * rows - 2.0 * cols, *at), 3 * at[0] - 2 * at[1])
    with_hole = np.where((rows == 2) & (cols == 0), np.nan, 1.0)
    assert np.isnan(tile_figures.along(with_hole, *at)).tolist() == [False, True, False]


def test_profile_shows_rasters_along_path(tile):
    figure = tile_figures.road_profile(tile)[1]
    path, *_ = next(axes for axes in figure.axes if axes.images).lines
    east, north = tile.grid.west + path.get_xdata(), tile.grid.south + path.get_ydata()
    row, col = tile.grid.cells(east, north)
    assert tile.street[row, col].mean() > 0.95, "the path leaves the road"
    heights, errors = (axes for axes in figure.axes if not axes.images)
    lines = {line.get_label(): line for line in heights.lines}
    # Heights are interpolated between cells, which is exact on a plane.
    plane = tile.results["plane"].mesh
    fit = np.linalg.lstsq(np.c_[plane.vertices[:, :2], np.ones(len(plane.vertices))], plane.vertices[:, 2])[0]
    expected = fit @ np.array([east - plane.origin[0], north - plane.origin[1], np.ones(east.size)])
    assert len(plane.vertices) == 4
    np.testing.assert_allclose(lines["Plane"].get_ydata(), expected + plane.origin[2], atol=1e-6)
    for line in errors.lines:
        whole = lines[line.get_label()].get_ydata()
        np.testing.assert_allclose(line.get_ydata(), whole - lines["reference surface"].get_ydata())
    measured = tile_figures.road_profile(replace(tile, against="the DTM"))[1]
    assert "DTM" in [line.get_label() for axes in measured.axes for line in axes.lines]


def test_trajectory_on_straight_road_is_right_of_centre():
    road = np.zeros((80, 120), bool)
    road[40:50] = True
    road[40:44, 60] = False  # a hole in the mask does not interrupt the road
    row, col = tile_view.vehicle_trajectory(road)
    assert np.ptp(col) > 95
    assert road[row.round().astype(int), col.round().astype(int)].mean() > 0.98
    # Rows increase southwards: eastbound traffic uses the southern half of the road.
    south = np.median(row) > 44.5
    assert south == (col[-1] > col[0])
    assert 1.5 < abs(np.median(row) - 44.5) < 3.5


def test_trajectory_at_fork_is_longest_path():
    road = np.zeros((150, 150), bool)
    road[70:78, :] = True
    road[:75, 40:48] = True
    row, col = tile_view.vehicle_trajectory(road)
    along = np.hypot(np.diff(row), np.diff(col)).sum()
    # From the northern to the eastern end.
    assert abs(along - (74 + 106)) < 30
    (north, _), (_, east) = sorted((row[i], col[i]) for i in (0, -1))
    assert north < 15
    assert east > 135


def test_trajectory_on_diagonal_road_ends_at_tile_edge():
    row, col = np.indices((200, 200))
    row, col = tile_view.vehicle_trajectory(np.abs(row - col) < 20)
    # The path is straight: one that continued along the tile's edge would be longer than its chord.
    along = np.hypot(np.diff(row), np.diff(col)).sum()
    assert along / np.hypot(row[-1] - row[0], col[-1] - col[0]) < 1.001
    assert along > 250


@pytest.mark.parametrize("cells", [0, 1, 2])
def test_trajectory_on_tiny_road_is_empty_or_short(cells):
    road = np.zeros((20, 20), bool)
    road[5, 5 : 5 + cells] = True
    row, col = tile_view.vehicle_trajectory(road)
    assert row.size == col.size <= 4


def test_vertex_colours_match_error_below(tile):
    colours = tile_figures.vertex_colours(tile, "rgt")
    mesh = tile.results["rgt"].mesh
    row, col = tile.grid.cells(mesh.vertices[:, 0] + mesh.origin[0], mesh.vertices[:, 1] + mesh.origin[1])
    error = tile.error("rgt")[row, col]
    colour = colormaps[tile_figures.ERROR_COLOURS]
    worst = np.argmax(error)
    assert tuple(colours[worst]) == colour(tile_figures.ERROR_NORM(error[worst]), bytes=True)[:3]
    exact = error < tile_figures.ERROR_NORM.vmin
    assert exact.any()
    assert (colours[exact] == colour(-1.0, bytes=True)[:3]).all(), "zero error is the lower end"


def test_busiest_is_square_with_most_dropped_cells():
    grid = Grid("EPSG:25832", 1000.0, 2250.0, 1.0, 250, 250)
    dropped = np.zeros(grid.shape, bool)
    dropped[10, 10] = dropped[200, 150:160] = True
    west, south, east, north = tile_figures.busiest(dropped, grid)
    assert (east - west, north - south) == (tile_figures.CLOSE_M, tile_figures.CLOSE_M)
    assert west <= 1150 < 1160 <= east
    assert south <= 2049 < 2050 <= north
    small = Grid("EPSG:25832", 1000.0, 2060.0, 1.0, 60, 50)
    assert tile_figures.busiest(np.zeros(small.shape, bool), small) == (1000.0, 2010.0, 1050.0, 2060.0)


def test_trade_off_shows_means_of_metrics_table(run, rows):
    figure = figures.trade_off(run.config, "flexroad", rows)[1]
    expected = {
        "Control grid": ["coarse", "flexroad", "fine"],
        "Degree p = q": ["quadratic", "flexroad"],
        "Sampling, road / terrain (m)": ["flexroad", "sparse"],
    }
    assert [axes.get_title() for axes in figure.axes] == list(expected)
    means = rows.groupby("variant")[["mad_road_deg", "l2_road_m"]].mean()
    for axes, variants in zip(figure.axes, expected.values(), strict=True):
        np.testing.assert_array_equal(axes.lines[0].get_xydata(), means.loc[variants].to_numpy())
        red = [line.get_xydata()[0] for line in axes.lines[1:] if line.get_color() == figures.PATH]
        np.testing.assert_array_equal(red, [means.loc["flexroad"].to_numpy()])
    assert [text.get_text() for text in figure.axes[0].texts] == ["8×8", "10×10", "14×14"]
    assert [text.get_text() for text in figure.axes[2].texts] == ["1 / 10", "2 / 20"]


def test_sweep_of_an_option_that_the_method_lacks_is_empty():
    chains = load_config("production").chains
    (full,) = chains
    assert figures.sweep(chains, full, ("fit.control_points",)) == {}
    assert figures.sweep(chains, full, ("sample.road_m", "sample.terrain_m")).keys() == {full}


def test_statistics_match_rasters_and_metrics_table(run, rows, made_survey):
    table = figures.statistics(run, "flexroad", rows).set_index("tile_id")
    assert list(table.index) == [tile.id for tile in run.catalog.tiles]
    for tile in run.catalog.tiles:
        path, *_ = tile.paths(tile.layer("dsm"))
        with rasterio.open(path) as file:
            heights = file.read(1, masked=True)
        assert table.height_range_m[tile.id] == pytest.approx(float(heights.max() - heights.min()), abs=1e-4)
        with rasterio.open(tile.paths(tile.layer("reference_road"))[0]) as file:
            share = 100 * (file.read(1) > 0).mean()
        assert table.road_percent[tile.id] == pytest.approx(share, abs=0.5)


def test_dataset_figure_counts_every_tile():
    table = pd.DataFrame(
        {
            "tile_id": list("abcdef"),
            "stratum": ["rural", "urban", "urban", "rural", "urban", "harbour"],
            "road_percent": [5.0, 18, 22, 4, 25, 9],
            "height_range_m": [60.0, 30, 35, 80, np.nan, 20],
        }
    )
    bars, roads, heights = figures.draw_dataset(table).axes
    assert [label.get_text() for label in bars.get_xticklabels()] == ["urban", "rural", "harbour"]
    assert [bar.get_height() for bar in bars.patches] == [3, 2, 1]
    assert sum(bar.get_height() for bar in roads.patches) == 6
    assert sum(bar.get_height() for bar in heights.patches) == 5
    assert roads.lines[0].get_xdata()[0] == pytest.approx(83 / 6)
    assert heights.lines[0].get_xdata()[0] == pytest.approx(45)


@pytest.fixture
def quick_renders(monkeypatch):
    """Replace the slow drawing of meshes by noise; `test_render` tests the drawing."""
    buffer = io.BytesIO()
    pixels = np.random.default_rng(0).integers(0, 255, (48, 64, 3), dtype=np.uint8)
    Image.fromarray(pixels).save(buffer, format="png")
    monkeypatch.setattr(
        tile_figures, "render_meshes", lambda meshes, *_: dict.fromkeys(meshes, buffer.getvalue())
    )


@pytest.mark.usefixtures("quick_renders")
def test_write_figures_twice_gives_equal_files_and_leaves_the_run_unchanged(run, rows, tmp_path):
    before = {path: path.stat().st_mtime_ns for path in run.path.rglob("*")}
    for name in ("one", "two"):
        assert figures.write_figures(run, tmp_path / name) == []
    assert {path: path.stat().st_mtime_ns for path in run.path.rglob("*")} == before
    page = (tmp_path / "one" / "figures.md").read_text()
    for name in FIGURE_NAMES:
        with Image.open(tmp_path / "one" / f"{name}.png") as picture:
            assert picture.width == 7 * DPI
            assert np.asarray(picture.convert("L")).std() > 10, f"{name} is blank"
        assert (tmp_path / "one" / f"{name}.pdf").read_bytes().startswith(b"%PDF")
        with Image.open(tmp_path / "one" / f"{name}.webp") as picture:
            assert picture.width == SMALL_PX
        assert f"({name}.png)" in page
    assert page.splitlines()[0] == collect(run).line
    assert tile_view.typical_tile(rows, "flexroad") in page
    for file in (tmp_path / "one").iterdir():
        assert file.read_bytes() == (tmp_path / "two" / file.name).read_bytes(), file.name


def test_write_figures_without_opengl_leaves_out_renders(run, tmp_path, monkeypatch):
    monkeypatch.setattr(tile_figures, "render_meshes", lambda meshes, *_: dict.fromkeys(meshes))
    (note,) = figures.write_figures(run, tmp_path)
    assert "ablation_renders" in note
    assert "OpenGL" in note
    assert not list(tmp_path.glob("ablation_renders*"))
    assert len(list(tmp_path.glob("*.pdf"))) == len(FIGURE_NAMES) - 1
    assert "OpenGL" in (tmp_path / "figures.md").read_text()


def test_write_figures_without_variants_lists_missing_figures(made_survey, tmp_path):
    only = finish_run(tmp_path / "run", made_survey, compose(BASE, "quick"))
    notes = figures.write_figures(only, tmp_path / "out", only.catalog.tiles[0].id)
    assert [note.split(":")[0].removeprefix("no figure ") for note in notes] == list(FIGURE_NAMES[:4])
    assert all("--config ablation" in note for note in notes)
    assert (tmp_path / "out" / "dataset.pdf").exists()


def test_write_figures_leaves_out_tiles_with_failed_variant(made_survey, tmp_path):
    part = finish_run(tmp_path / "run", made_survey, compose(BASE, "quick"))
    table = read_metrics(part.path)
    failed = table.tile_id.iloc[0]
    table.loc[table.tile_id == failed, "status"] = "failed"
    table.to_parquet(part.path / "metrics.parquet", index=False)
    figures.write_figures(part, tmp_path / "out")
    assert "The 3 tiles" in (tmp_path / "out" / "figures.md").read_text()
    table.assign(status="failed").to_parquet(part.path / "metrics.parquet", index=False)
    with pytest.raises(ConfigError, match="flexroad status"):
        figures.write_figures(part, tmp_path / "out")


def test_write_figures_unknown_tile_raises(run, tmp_path):
    with pytest.raises(CatalogError, match="0_0"):
        figures.write_figures(run, tmp_path, "0_0")
