import numpy as np
import pytest

from flexroad.catalog.grid import Bounds
from flexroad.tasks.errors import TaskError
from flexroad.tasks.roads.routes import CentreLine, Route
from flexroad.tasks.spline.surface import NurbsSurface, clamped_knots
from flexroad.tools.export import opencrg, profiles
from flexroad.tools.export.georeference import LocalFrame
from flexroad.tools.export.profiles import HeightGrid
from flexroad.tools.export.reference_line import reference_line

SOUTH_WEST = (366_000.0, 5_621_000.0)
BENDS = np.array([[20.0, 30.0], [70.0, 60.0], [120.0, 70.0], [150.0, 120.0], [150.0, 180.0], [120.0, 225.0]])


def surface() -> NurbsSurface:
    """Return a hilly NURBS of 250 m with weights, some 1,200 m above the sea."""
    rng = np.random.default_rng(4)
    weights = np.exp(rng.uniform(-0.2, 0.2, (35, 35)))
    heights = (
        3 * np.sin(np.arange(35) / 5) + 2 * np.cos(np.arange(35)[:, None] / 4) + rng.normal(0, 0.05, (35, 35))
    )
    west, south = SOUTH_WEST
    bounds: Bounds = (west, south, west + 250, south + 250)
    knots = clamped_knots(35, 3)
    return NurbsSurface(
        "EPSG:25832", bounds, (3, 3), knots, knots, heights * weights, weights, 1234.5, SOUTH_WEST
    )


FRAME = LocalFrame.around("EPSG:25832", SOUTH_WEST[0] + 3000, SOUTH_WEST[1] - 2000)


def height(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return the surface's heights at points of the local frame."""
    return surface().height(*FRAME.to_run(x, y))


def grid(points: np.ndarray = BENDS) -> HeightGrid:
    x, y = FRAME.to_local(*(points + SOUTH_WEST).T)
    line = reference_line(Route((CentreLine(np.stack([x, y], axis=1), 6.0),)))
    assert line is not None
    return profiles.height_grid(line, height)


def read(data: bytes) -> tuple[dict[str, float], list[str], np.ndarray]:
    """Return header values, section names and rows, read literally by the format's description."""
    head, body = data.split(b"\n" + b"$" * 80 + b"\n", 1)
    lines = head.decode("ascii").splitlines()
    sections = [line for line in lines if line.startswith("$") and line != "$"]
    values = {key.strip(): float(value) for key, value in (line.split("=") for line in lines if "=" in line)}
    channels = [line for line in lines if line.startswith("D:")]
    assert "#:KRBI" in lines
    assert len(body) % 80 == 0
    rows = round((values["REFERENCE_LINE_END_U"] - values["REFERENCE_LINE_START_U"]) / increment(values)) + 1
    numbers = np.frombuffer(body, ">f4")
    assert np.isnan(numbers[rows * len(channels) :]).all()
    assert channels == ["D:reference line phi,rad"] + [
        f"D:long section {k},m" for k in range(1, len(channels))
    ]
    return values, sections, numbers[: rows * len(channels)].reshape(rows, -1).astype(float)


def increment(values: dict[str, float]) -> float:
    return values["REFERENCE_LINE_INCREMENT"]


def positions(values: dict[str, float], rows: np.ndarray) -> np.ndarray:
    """Return the points of the reference line, ``(n, 2)``: each heading leads to its own row."""
    step = increment(values) * np.stack([np.cos(rows[1:, 0]), np.sin(rows[1:, 0])], axis=1)
    start = [values["REFERENCE_LINE_START_X"], values["REFERENCE_LINE_START_Y"]]
    return np.concatenate([[start], start + np.cumsum(step, axis=0)])


def test_encode_line_and_heights_are_those_of_the_surface():
    truth = grid()
    values, sections, rows = read(opencrg.encode(truth, "EPSG:25832"))
    assert sections == ["$CT", "$ROAD_CRG_MODS", "$ROAD_CRG", "$KD_DEFINITION"]
    line = positions(values, rows)
    np.testing.assert_allclose(line, np.stack([truth.line.x, truth.line.y], axis=1), atol=1e-4)
    end = [values["REFERENCE_LINE_END_X"], values["REFERENCE_LINE_END_Y"]]
    np.testing.assert_array_equal(end, (truth.line.x[-1], truth.line.y[-1]))
    assert values["REFERENCE_LINE_START_PHI"] == pytest.approx(rows[1, 0], abs=1e-6)
    assert values["REFERENCE_LINE_END_PHI"] == pytest.approx(rows[-1, 0], abs=1e-6)
    # Columns go from right to left. In the middle of the line's points the normal is that of both chords.
    count = rows.shape[1] - 1
    v = np.linspace(values["LONG_SECTION_V_RIGHT"], values["LONG_SECTION_V_LEFT"], count)
    assert np.diff(v) == pytest.approx(values["LONG_SECTION_V_INCREMENT"])
    along = line[2:] - line[:-2]
    left = np.stack([-along[:, 1], along[:, 0]], axis=1) / np.linalg.norm(along, axis=1)[:, None]
    places = line[1:-1, None] + v[None, :, None] * left[:, None]
    z = values["REFERENCE_LINE_START_Z"] + rows[1:-1, 1:]
    assert np.abs(z - height(places[..., 0], places[..., 1])).max() < 0.0005


def test_encode_unknown_heights_are_nan():
    whole = grid()
    holed = whole.heights.copy()
    holed[3:6, :4] = np.nan
    _, _, rows = read(opencrg.encode(HeightGrid(whole.line, whole.v, holed)))
    np.testing.assert_array_equal(np.isnan(rows[:, 1:]), np.isnan(holed))


def test_encode_comment_is_ascii_and_opens_no_section():
    comment = "Straße nach Köln\n$ROAD_CRG_OPTS\n" + "x" * 100
    data = opencrg.encode(grid(), comment)
    _, sections, _ = read(data)
    assert "$ROAD_CRG_OPTS" not in sections
    head = data[: data.index(b"$" * 80)]
    assert max(map(len, head.splitlines())) <= 72


def test_encode_without_any_height_says_where_the_road_is():
    whole = grid()
    with pytest.raises(TaskError, match=r"the road at x -3030\.5, y 1954\.6 has no height"):
        opencrg.encode(HeightGrid(whole.line, whole.v, whole.heights * np.nan))


def test_encode_read_by_pyopencrg_is_within_2_mm_of_the_surface(tmp_path, monkeypatch):
    pyopencrg = pytest.importorskip("pyopencrg")
    path = tmp_path / "road.crg"
    monkeypatch.setattr(profiles, "MARGIN_M", 2.0)
    truth = grid()
    path.write_bytes(opencrg.encode(truth, "EPSG:25832"))
    for apply_mods in (False, True):
        road = pyopencrg.CrgRoad.read(path, apply_mods=apply_mods)
        assert road.check().ok
        np.testing.assert_allclose(road.x, truth.line.x, atol=1e-5)
        rng = np.random.default_rng(0)
        u, v = rng.uniform(0, road.u_end, 2000), rng.uniform(truth.v[0], truth.v[-1], 2000)
        x, y = road.uv_to_xy(u, v)
        assert np.abs(road.xy_to_z(x, y) - height(x, y)).max() < 0.002
