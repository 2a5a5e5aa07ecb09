"""Scripts of the viewer: rasters within half a step, thinned at the right places; texts stay texts."""

import base64
import io
import json
import zlib

import numpy as np
import pytest
from PIL import Image

from flexroad.catalog.grid import Grid
from flexroad.tasks.spline.stepped import SteppedSurface, without_steps
from flexroad.tools.view.encoding import (
    ESTIMATE_STEP_M,
    MOST_CELLS,
    encode_run,
    encode_tile,
    picture,
)

GRID = Grid("EPSG:25832", 500000.0, 5600000.0, 1.0, 40, 30)


def encoded(grid=GRID, **values):
    height_source = np.ones(grid.shape, np.uint8)
    return content(encode_tile("a", b"glTF", grid, np.zeros((4, 2)), height_source, **values))


def content(script):
    text = script.decode("ascii")
    assert text.startswith("FLEXROAD.tile(")
    assert text.endswith(");\n")
    return json.loads(f"[{text[len('FLEXROAD.tile(') : -3]}]")[1]


def numbers(text, dtype, grid):
    return np.frombuffer(zlib.decompress(base64.b64decode(text)), dtype).reshape(grid["rows"], grid["cols"])


def heights(raster, grid):
    codes = numbers(raster["data"], "<u2", grid)
    return np.where(codes == 0, np.nan, raster["low"] + (codes - 1.0) * raster["step"])


@pytest.mark.parametrize("span_m", [0.0, 5.0, 60.0, 4000.0])
def test_heights_are_within_half_a_step_and_voids_stay(span_m):
    dsm = np.linspace(-20.0, -20.0 + span_m, GRID.width * GRID.height).reshape(GRID.shape)
    dsm[3, 4] = np.nan
    made = encoded(dsm=dsm, dtm=np.full(GRID.shape, np.nan))
    found = heights(made["dsm"], made["grid"])
    assert made["dsm"]["step"] <= max(0.001, span_m / 65000)
    np.testing.assert_allclose(found, dsm, rtol=0, atol=0.51 * made["dsm"]["step"])
    assert made["dtm"] is None


@pytest.mark.parametrize("size", [MOST_CELLS, MOST_CELLS + 1, 2 * MOST_CELLS + 5, 1000])
def test_thinned_cells_have_their_own_heights_at_their_centres(size):
    grid = Grid("EPSG:25832", 500000.0, 5600000.0, 0.5, size, size)
    eastings, northings = np.meshgrid(grid.eastings, grid.northings)
    plane = 0.01 * (eastings - grid.west) - 0.02 * (northings - grid.south)
    made = encoded(grid, dsm=plane)
    placed = made["grid"]
    assert max(placed["rows"], placed["cols"]) <= MOST_CELLS
    east = placed["west"] + (np.arange(placed["cols"]) + 0.5) * placed["cell"]
    north = placed["north"] - (np.arange(placed["rows"]) + 0.5) * placed["cell"]
    expected = 0.01 * (east[None, :] - grid.west) - 0.02 * (north[:, None] - grid.south)
    np.testing.assert_allclose(heights(made["dsm"], placed), expected, rtol=0, atol=0.001)


def test_error_estimates_are_within_half_a_step_up_to_half_a_metre():
    estimate = np.linspace(0, 0.5, GRID.width * GRID.height).reshape(GRID.shape)
    estimate[0, 0], estimate[0, 1] = np.nan, 7.0
    made = encoded(estimate=estimate)
    codes = numbers(made["estimate"], np.uint8, made["grid"])
    assert codes[0, 0] == 0
    assert codes[0, 1] == 255
    np.testing.assert_allclose((codes[1:] - 1.0) * ESTIMATE_STEP_M, estimate[1:], rtol=0, atol=0.00101)


def test_picture_has_roads_darker_and_slopes_to_the_sun_brighter():
    eastings, northings = np.meshgrid(np.arange(200.0), np.arange(100.0)[::-1])
    road = (eastings > 120) & (eastings < 150)
    seen = np.asarray(Image.open(io.BytesIO(picture(np.zeros((100, 200)), road, 1.0))).convert("L"), int)
    assert seen.shape == (32, 64)
    assert seen[:, 42].max() < seen[:, 10].min() - 60
    # The sun is in the north-west: a slope that rises to the south-east faces it.
    towards, away = (
        np.asarray(
            Image.open(io.BytesIO(picture(rise * (eastings - northings), road, 1.0))).convert("L"), int
        )
        for rise in (0.1, -0.1)
    )
    assert towards[16, 10] > away[16, 10] + 30


def test_picture_is_transparent_beyond_the_survey():
    height = np.zeros((100, 200))
    height[:, 100:] = np.nan
    seen = np.asarray(Image.open(io.BytesIO(picture(height, np.zeros(height.shape, bool), 1.0))))
    assert seen.shape == (32, 64, 4)
    assert (seen[:, :30, 3] > 250).all()
    assert (seen[:, 34:, 3] < 5).all()


def test_texts_of_the_index_stay_texts():
    script = encode_run({"name": '</script>"\u2028ä', "values": [float("nan"), 1.5]})
    assert script.isascii()
    (index,) = json.loads(f"[{script.decode()[len('FLEXROAD.run(') : -3]}]")
    assert index == {"name": '</script>"\u2028ä', "values": [None, 1.5]}


def test_steps_beside_roads_are_of_every_cell_and_exactly_none_on_the_road():
    cells = Grid("EPSG:25832", 500000.0, 5600000.0, 0.5, 2 * MOST_CELLS, 40)
    steps = np.zeros(cells.shape, np.float32)
    steps[10:20] = np.linspace(-4, 4, cells.width)
    knots = np.array([0.0, 0, 1, 1])
    spline = {"crs": cells.crs, "bounds": cells.exact_bounds, "degree": (1, 1), "datum": 0.0}
    spline |= {"knots_u": knots, "knots_v": knots, "A": np.ones((2, 2)), "W": np.ones((2, 2))}
    spline |= {"south_north": np.zeros((2, cells.width)), "west_east": np.zeros((2, cells.height))}
    surface = SteppedSurface(**spline, origin=cells.origin, steps=steps, cells=cells)
    packed = encoded(cells, surface=surface)["steps"]
    assert (packed["grid"]["rows"], packed["grid"]["cols"]) == cells.shape
    found = np.nan_to_num(heights(packed, packed["grid"]))
    np.testing.assert_allclose(found, steps, rtol=0, atol=0.0006)
    assert (found[steps == 0] == 0).all()
    smooth = encoded(cells, surface=without_steps(surface))
    assert smooth["steps"] is None
