"""Pictures of the report, and the background of its map: relief, roads and the limit of the survey."""

import io
import logging
import re
import subprocess
import sys

import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image

from flexroad.catalog import Grid
from flexroad.tasks.types import Mesh, RoadMask
from flexroad.tools.report import render
from flexroad.tools.report.pictures import _square, render_meshes, webp

GRID = Grid("EPSG:25832", 295500.0, 5629500.0, 1.0, 250, 250)
ROW, COL = np.indices(GRID.shape)
RELIEF = 150 + 5 * np.sin(COL / 40) + 3 * np.cos(ROW / 25)
NOISE = np.random.default_rng(0).normal(0, 0.1, GRID.shape)


def pixels(png: bytes) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(png)).convert("RGB")).astype(int)


def on_map(png: bytes, row: int, col: int) -> np.ndarray:
    """Return the mean colour around a cell of a 250 x 250 map without title."""
    scale, top = render.MAP_PX / 250, 8
    y, x = top + (row + 0.5) * scale, render.LEFT_PX + (col + 0.5) * scale
    return pixels(png)[int(y) - 3 : int(y) + 4, int(x) - 3 : int(x) + 4].mean(axis=(0, 1))


def near(colour: np.ndarray, name: str, tolerance: float = 40) -> bool:
    wanted = np.array([int(name[i : i + 2], 16) for i in (1, 3, 5)])
    return bool(np.abs(colour - wanted).max() < tolerance)


def ramp_end(i: int) -> np.ndarray:
    return np.array(render.RELIEF(float(i))[:3]) * 255


def test_hillshade_has_north_up_and_high_ground_in_light_colours():
    high_north = np.where(ROW < 125, 20.0, 10.0)
    png = render.hillshade(high_north, GRID)
    np.testing.assert_allclose(on_map(png, 30, 125), ramp_end(1), atol=3)
    np.testing.assert_allclose(on_map(png, 220, 125), ramp_end(0), atol=3)


def test_hillshade_is_lit_from_north_west():
    cone = -0.5 * np.hypot(ROW - 125, COL - 125)
    png = render.hillshade(cone, GRID)
    light = {side: on_map(png, *at).mean() for side, at in {"nw": (65, 65), "se": (185, 185)}.items()}
    assert light["nw"] > light["se"] + 25


def test_hillshade_nan_cells_have_nodata_colour():
    holes = np.where((ROW > 100) & (COL > 100), np.nan, RELIEF)
    png = render.hillshade(holes, GRID)
    assert near(on_map(png, 200, 200), render.UNKNOWN, 2)
    assert not near(on_map(png, 50, 50), render.UNKNOWN, 10)


def test_filter_picture_colours_kept_and_dropped_cells():
    raw = np.abs(COL - 60) < 12
    kept = raw & (ROW > 80)
    png = render.filter_picture(RELIEF, raw, kept, GRID)
    r, _, b = on_map(png, 180, 60)
    assert b > r + 60, "kept is blue"
    r, _, b = on_map(png, 40, 60)
    assert r > b + 60, "dropped is orange"
    neutral = on_map(png, 125, 180)
    assert np.ptp(neutral) < 20


def test_height_source_picture_colours_three_classes_on_road_only():
    road = np.abs(COL - 60) < 12
    png = render.height_source_picture(RELIEF, (1 + ROW // 84).astype(np.uint8), road, GRID)
    for row, colour in ((40, render.KEPT), (125, render.BY_DTM), (210, render.DROPPED)):
        assert near(on_map(png, row, 60), colour, 75)
    assert np.ptp(on_map(png, 125, 180)) < 20


def test_error_map_is_red_where_too_high_and_blue_where_too_low():
    error = np.where(ROW < 125, 0.08, -0.08)
    error[:, 200:] = np.nan
    png = render.error_map(error, GRID, limit_m=0.1)
    r, _, b = on_map(png, 60, 60)
    assert r > b + 80
    r, _, b = on_map(png, 190, 60)
    assert b > r + 80
    assert near(on_map(png, 125, 225), render.UNKNOWN, 2)


def test_error_map_default_limit_is_round_and_robust():
    error = 0.03 * np.sin(ROW / 9) * np.cos(COL / 7)
    error[0, :100] = 40.0
    assert render.error_map(error, GRID) == render.error_map(error, GRID, limit_m=0.05)
    assert render.error_map(error, GRID) != render.error_map(error, GRID, limit_m=0.1)


def test_error_map_with_road_draws_its_outline():
    error, road = np.zeros(GRID.shape), np.abs(COL - 125) < 50
    png = render.error_map(error, GRID, road=road, limit_m=0.1)
    strip = pixels(png)[150:160, render.LEFT_PX + 5 : render.LEFT_PX + render.MAP_PX - 5].mean(axis=(0, 2))
    dark = np.flatnonzero(strip < 180) / render.MAP_PX * 250
    assert len(dark) >= 2
    np.testing.assert_allclose([dark.min(), dark.max()], [76 - 5 * 0.73, 175 - 5 * 0.73], atol=2.5)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("heights", [np.full(GRID.shape, np.nan), RELIEF + NOISE], ids=["empty", "noise"])
def test_pictures_of_any_data_are_drawn_and_small(heights):
    raw, kept = NOISE > 0, NOISE > 0.1
    for png in (
        render.hillshade(heights, GRID),
        render.filter_picture(heights, raw, kept, GRID),
        render.error_map(heights - RELIEF, GRID, road=kept),
    ):
        assert len(png) < 120_000
        assert pixels(png).shape[1] == render.WIDTH_PX == 480


@pytest.mark.parametrize(("width", "height"), [(40, 250), (250, 40), (3, 3), (900, 1200)])
def test_hillshade_of_any_shape_has_fixed_width(width, height):
    grid = Grid("EPSG:25832", 0.0, 100.0, 0.4, width, height)
    heights = np.add.outer(np.arange(height), np.arange(width)) * 0.1
    rows, columns, _ = pixels(render.hillshade(heights, grid)).shape
    assert columns == 480
    assert rows < 2 * render.MAP_PX + 80


def sheet(n: int = 26) -> Mesh:
    """Return a square of 250 m with gentle hills; its western third is road."""
    x, y = np.meshgrid(np.linspace(0, 250, n), np.linspace(0, 250, n))
    i = np.arange(n * n).reshape(n, n)
    a, b, c, d = i[:-1, :-1].ravel(), i[:-1, 1:].ravel(), i[1:, 1:].ravel(), i[1:, :-1].ravel()
    faces = np.concatenate([np.c_[a, b, c], np.c_[a, c, d]]).astype(np.int32)
    vertices = np.c_[x.ravel(), y.ravel(), np.sin(x / 30).ravel()]
    return Mesh(
        "EPSG:25832", (295500.0, 5629250.0, 150.0), vertices, faces, vertices[faces][:, :, 0].mean(1) < 83
    )


@pytest.fixture(scope="module")
def opengl():
    """Skip the test if VTK alone, without our code, cannot draw."""
    probe = "import pyvista as pv; p = pv.Plotter(off_screen=True); p.add_mesh(pv.Cube()); p.screenshot()"
    if subprocess.run([sys.executable, "-c", probe], capture_output=True, check=False).returncode:
        pytest.skip("no OpenGL library on this machine")


@pytest.mark.slow
@pytest.mark.usefixtures("opengl")
def test_render_meshes_road_is_on_the_left_and_broken_mesh_is_none():
    whole = sheet()
    broken = Mesh(whole.crs, whole.origin, whole.vertices[:, :2], whole.faces, whole.road)
    pictures = render_meshes({"b": whole, "broken": broken, "a": whole})
    assert list(pictures) == ["b", "broken", "a"]
    assert pictures["broken"] is None
    assert pictures["a"] == pictures["b"]
    assert pictures["a"] is not None
    assert len(pictures["a"]) < 120_000
    image = pixels(pictures["a"])[:-20]  # without the line of text
    dark = image.max(axis=2) < 110
    drawn = image.min(axis=2) < 250
    columns = np.arange(image.shape[1])
    assert drawn.mean() > 0.25
    assert dark.sum() > 0.2 * drawn.sum()
    assert (dark.sum(0) * columns).sum() / dark.sum() < (drawn.sum(0) * columns).sum() / drawn.sum() - 50


@pytest.mark.slow
@pytest.mark.usefixtures("opengl")
def test_render_meshes_draws_part_in_given_colours():
    whole = sheet()
    red_in_the_west = np.where(whole.vertices[:, :1] < 125, [[200, 30, 30]], [[30, 30, 200]]).astype(np.uint8)
    west, south = whole.origin[:2]
    shares = []
    for within in (None, (west + 150, south + 50, west + 240, south + 200)):
        picture = render_meshes({"a": whole}, {"a": red_in_the_west}, within, (300, 240))["a"]
        image = pixels(picture)
        assert image.shape == (240, 300, 3)
        red, blue = ((image[..., a] - image[..., b]) > 60 for a, b in ((0, 2), (2, 0)))
        shares.append((red.mean(), blue.mean()))
    assert min(shares[0]) > 0.05
    assert shares[1][0] == 0
    assert shares[1][1] > shares[0][1], "the part does not fill the picture"


def test_render_meshes_without_meshes_starts_no_child(monkeypatch):
    monkeypatch.setattr(sys, "executable", "/nonexistent")
    assert render_meshes({}) == {}


@pytest.mark.skipif(sys.platform == "win32", reason="the stand-in for VTK is a shell script")
@pytest.mark.parametrize(
    ("script", "reason"),
    [("kill -SEGV $$", "signal 11.*libegl1"), ("echo no module vtk >&2; exit 1", "no module vtk")],
)
def test_render_meshes_failing_child_gives_none_and_warns(tmp_path, monkeypatch, caplog, script, reason):
    stand_in = tmp_path / "python"
    stand_in.write_text(f"#!/bin/sh\n{script}\n")
    stand_in.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(stand_in))
    with caplog.at_level(logging.WARNING):
        assert render_meshes({"a": sheet(), "b": sheet()}) == {"a": None, "b": None}
    (record,) = caplog.records
    assert re.search(f"a, b: .*{reason}", record.getMessage())


TILE = Grid("EPSG:25832", 500_000.0, 5_600_250.0, 1.0, 250, 250)


def labels(places):
    axes = Figure().subplots()
    render._circles(axes, TILE, places)
    return {text.get_text(): text.xy for text in axes.texts}


def test_labels_of_near_places_do_not_overlap():
    east, north = 500_120.0, 5_600_140.0
    places = {"spike": (east, north), "patch": (east + 3, north + 1), "loose": (east + 6, north + 3)}
    (_, first), (_, second), (_, third) = (labels(places)[name] for name in places)
    assert first == 140
    assert second - first >= render.LINE * 250 - 1e-9
    assert third - second >= render.LINE * 250 - 1e-9


def test_labels_of_far_places_and_flags_of_one_place_stay_where_they_are():
    places = {"spike": (500_020.0, 5_600_100.0), "patch": (500_230.0, 5_600_101.0)}
    assert labels(places) == {"spike": (20, 100), "patch": (230, 101)}
    assert labels(dict.fromkeys(("spike", "patch"), (500_020.0, 5_600_100.0))) == {"spike, patch": (20, 100)}


CORE = Grid("EPSG:25832", 588_000.0, 5_519_250.0, 1.0, 250, 250)
WIDE = Grid("EPSG:25832", 587_950.0, 5_519_300.0, 1.0, 350, 350)
WIDE_ROW, WIDE_COL = np.indices(WIDE.shape)


class Slope:
    """A plane that rises to one side."""

    bounds = WIDE.bounds

    def __init__(self, east, north):
        self.east, self.north = east, north

    def lattice(self, eastings, northings):
        return self.east * eastings[None, :] + self.north * northings[:, None]


def square(surface, mask=WIDE_ROW < 0, outside=WIDE_ROW < 0, side=50):
    return _square(surface, RoadMask(WIDE, CORE, mask, outside), side).astype(int)


def test_roads_are_darker_where_they_lie():
    # The core begins 50 cells into the grid.
    grey = square(Slope(0, 0), mask=(WIDE_COL >= 50) & (WIDE_COL < 100))[..., 0]
    assert grey[:, :10].max() < grey[:, 10:].min() - 50
    assert grey.shape == (50, 50)


def test_slopes_that_face_north_west_are_lighter():
    assert square(Slope(0.1, -0.1))[..., 0].mean() > square(Slope(-0.1, 0.1))[..., 0].mean() + 20


def test_cells_beyond_the_survey_are_transparent():
    opacity = square(Slope(0, 0), outside=WIDE_ROW >= 175)[..., 1]
    assert (opacity[:25] == 255).all()
    assert (opacity[25:] == 0).all()


def test_webp_is_smaller_and_has_the_width_asked_for():
    buffer = io.BytesIO()
    noise = np.random.default_rng(0).integers(0, 255, (300, 400, 3)).astype(np.uint8)
    Image.fromarray(noise).save(buffer, "png")
    small = webp(buffer.getvalue(), 200)
    assert Image.open(io.BytesIO(small)).size == (200, 150)
    assert len(small) < len(buffer.getvalue())
    assert Image.open(io.BytesIO(webp(buffer.getvalue(), 500))).size == (400, 300)
