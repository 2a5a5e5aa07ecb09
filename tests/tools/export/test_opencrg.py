import re
from dataclasses import replace

import numpy as np
import pytest
from pyopencrg import CrgRoad

from flexroad.tasks.errors import TaskError
from flexroad.tasks.roads.routes import CentreLine, Route
from flexroad.tasks.spline.surface import NurbsSurface
from flexroad.tools.export import opencrg, profiles
from flexroad.tools.export.georeference import LocalFrame
from flexroad.tools.export.profiles import HeightGrid
from flexroad.tools.export.reference_line import reference_line
from tests.builders import make_surface

SOUTH_WEST = (366_000.0, 5_621_000.0)
BENDS = np.array([[20.0, 30.0], [70.0, 60.0], [120.0, 70.0], [150.0, 120.0], [150.0, 180.0], [120.0, 225.0]])


def surface() -> NurbsSurface:
    """Return a hilly NURBS of 250 m with weights, some 1,200 m above the sea."""
    rows, columns = np.indices((35, 35))
    heights = 3 * np.sin(columns / 5) + 2 * np.cos(rows / 4)
    made = make_surface((35, 35), seed=4, relief_m=0.05, bounds=(*SOUTH_WEST, *np.add(SOUTH_WEST, 250)))
    return replace(made, A=made.A + heights * made.W, datum=1234.5, origin=SOUTH_WEST)


FRAME = LocalFrame.around("EPSG:25832", SOUTH_WEST[0] + 3000, SOUTH_WEST[1] - 2000)


def height(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return the surface's heights at points of the local frame."""
    return surface().height(*FRAME.to_run(x, y))


def grid(points: np.ndarray = BENDS) -> HeightGrid:
    x, y = FRAME.to_local(*(points + SOUTH_WEST).T)
    line = reference_line(Route((CentreLine(np.stack([x, y], axis=1), 6.0),)))
    assert line is not None
    return profiles.height_grid(line, height)


def test_encode_comment_is_ascii_and_opens_no_section():
    data = opencrg.encode(grid(), "Straße nach Köln\n$ROAD_CRG_OPTS\n" + "x" * 100)
    head, body = data.split(b"\n" + b"$" * 80 + b"\n", 1)
    lines = head.decode("ascii").splitlines()
    sections = [line for line in lines if line.startswith("$") and line != "$"]
    assert sections == ["$CT", "$ROAD_CRG_MODS", "$ROAD_CRG", "$KD_DEFINITION"]
    assert max(map(len, lines)) <= 72
    assert len(body) % 80 == 0


def test_encode_without_any_height_says_where_the_road_is():
    whole = grid()
    with pytest.raises(TaskError, match=r"the road at x -3030\.5, y 1954\.6 has no height"):
        opencrg.encode(HeightGrid(whole.line, whole.v, whole.heights * np.nan))


@pytest.mark.parametrize("apply_mods", [False, True])
def test_encode_read_by_pyopencrg_has_the_line_and_the_heights_of_the_surface(
    tmp_path, monkeypatch, apply_mods
):
    path = tmp_path / "road.crg"
    monkeypatch.setattr(profiles, "MARGIN_M", 2.0)
    truth = grid()
    path.write_bytes(opencrg.encode(truth, "EPSG:25832"))
    road = CrgRoad.read(path, apply_mods=apply_mods)
    assert road.check().ok
    np.testing.assert_allclose([road.x, road.y], [truth.line.x, truth.line.y], atol=1e-4)
    np.testing.assert_allclose(road.v, truth.v, atol=1e-9)
    np.testing.assert_allclose(road.surface_z(), truth.heights, atol=1e-4)
    ends = re.findall(rb"REFERENCE_LINE_(?:START|END)_PHI\s*=\s*(\S+)", path.read_bytes())
    assert [float(end) for end in ends] == pytest.approx(truth.line.chord_headings[[0, -1]], abs=1e-6)
    rng = np.random.default_rng(0)
    u, v = rng.uniform(0, road.u_end, 2000), rng.uniform(truth.v[0], truth.v[-1], 2000)
    x, y = road.uv_to_xy(u, v)
    assert np.abs(road.xy_to_z(x, y) - height(x, y)).max() < 0.002


def test_encode_unknown_heights_are_nan(tmp_path):
    whole = grid()
    holed = whole.heights.copy()
    holed[3:6, :4] = np.nan
    (tmp_path / "road.crg").write_bytes(opencrg.encode(HeightGrid(whole.line, whole.v, holed)))
    np.testing.assert_array_equal(np.isnan(CrgRoad.read(tmp_path / "road.crg").z), np.isnan(holed))
