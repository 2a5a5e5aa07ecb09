import io
import json
import struct
from dataclasses import dataclass

import numpy as np
import pytest
from PIL import Image

from flexroad.catalog.grid import Grid
from flexroad.tasks.errors import TaskError
from flexroad.tasks.export import heightfield
from flexroad.tasks.export.heightfield import sampled, size_at_spacing
from flexroad.tasks.types import RoadMask

BOUNDS = (295500.0, 5629250.0, 295750.0, 5629500.0)


@dataclass(frozen=True)
class Hills:
    """A slope to the east and hills; no height east of ``hole``."""

    hole: float = np.inf
    relief: float = 1.0
    bounds = BOUNDS

    def height(self, easting, northing):
        x, y = easting - BOUNDS[0], northing - BOUNDS[1]
        z = 150 + self.relief * (0.1 * x + 3 * np.sin(x / 17) + 2 * np.cos(y / 11))
        return np.where(easting > self.hole, np.nan, z)

    def lattice(self, eastings, northings):
        return self.height(eastings[None, :], northings[:, None])

    def normal(self, easting, northing):
        raise NotImplementedError


class Ramp(Hills):
    """A slope of 10% to the east from 150 m."""

    def height(self, easting, northing):
        return 150 + 0.1 * (easting - BOUNDS[0]) + 0 * northing


def truth(size: int, surface=None) -> np.ndarray:
    """Return the heights at the nodes, row 0 in the north, by the definition of the nodes."""
    i = np.arange(size) / (size - 1)
    x, y = BOUNDS[0] + i * 250, BOUNDS[3] - i * 250
    return (surface or Hills()).height(x[None, :], y[:, None])


def sidecar(field) -> dict:
    return json.loads(heightfield.encode_sidecar(field, "EPSG:25832", "EPSG:7837"))


@pytest.mark.parametrize("size", [257, 505])
def test_png_reads_back_within_half_a_step(size):
    field = sampled(Hills(), BOUNDS, size)
    image = np.asarray(Image.open(io.BytesIO(heightfield.encode_png(field))))
    content = sidecar(field)
    assert (image.dtype, image.shape) == (np.uint16, (size, size))
    assert (image.min(), image.max()) == (0, 65535)
    read = content["low_m"] + image * content["step_m"]
    expected = truth(size)
    half = (expected.max() - expected.min()) / 65535 / 2
    assert content["precision_m"] == pytest.approx(half)
    assert half * 0.9 < np.abs(read - expected).max() <= half * (1 + 1e-9)


def test_r16_has_the_values_of_the_png():
    field = sampled(Hills(), BOUNDS, 129)
    values = np.frombuffer(heightfield.encode_r16(field), "<u2").reshape(129, 129)
    np.testing.assert_array_equal(values, np.asarray(Image.open(io.BytesIO(heightfield.encode_png(field)))))


def test_sampled_nodes_lie_on_all_edges():
    field = sampled(Hills(), BOUNDS, 33)
    west, south, east, north = BOUNDS
    corners = Hills().height(np.array([west, east, west, east]), np.array([north, north, south, south]))
    np.testing.assert_array_equal(field.heights[[0, 0, -1, -1], [0, -1, 0, -1]], corners)


def test_sampled_more_rows_than_evaluated_at_a_time_equals_truth():
    field = sampled(Hills(), BOUNDS, 513)
    assert heightfield.ROWS < 513
    np.testing.assert_allclose(field.heights, truth(513), atol=1e-9)


def test_mujoco_rows_begin_in_the_south_and_read_back():
    field = sampled(Hills(), BOUNDS, 65)
    data = heightfield.encode_mujoco(field)
    assert struct.unpack("<ii", data[:8]) == (65, 65)
    unit = np.frombuffer(data[8:], "<f4").reshape(65, 65)
    assert (unit.min(), unit.max()) == (0, 1)
    content = sidecar(field)
    read = content["origin"][2] + content["mujoco"]["pos"][2] + unit * content["mujoco"]["size"][2]
    np.testing.assert_allclose(read[::-1], truth(65), atol=5e-6)
    assert content["mujoco"]["size"][:2] == content["mujoco"]["pos"][:2] == [125, 125]


def test_limits_give_neighbours_equal_steps():
    field = sampled(Hills(), BOUNDS, 33, (100.0, 300.0))
    read = 100 + field.values * (200 / 65535)
    np.testing.assert_allclose(read, truth(33), atol=200 / 65535 / 2 * (1 + 1e-9))
    content = sidecar(field)
    unit = np.frombuffer(heightfield.encode_mujoco(field)[8:], "<f4").reshape(33, 33)
    read = content["origin"][2] + content["mujoco"]["pos"][2] + unit * content["mujoco"]["size"][2]
    np.testing.assert_allclose(read[::-1], truth(33), atol=5e-6)


def test_unreal_settings_give_the_heights():
    """Unreal: z (cm) = origin + (value - 32768) / 128 * scale, with the landscape's formula."""
    field = sampled(Hills(), BOUNDS, 127)
    unreal = sidecar(field)["unreal"]
    z_m = (unreal["origin_z_cm"] + (field.values.astype(float) - 32768) / 128 * unreal["scale"][2]) / 100
    np.testing.assert_allclose(z_m, truth(127), atol=field.step_m / 2 * (1 + 1e-6))
    assert unreal["scale"][0] * 126 == pytest.approx(25000)


def test_sidecar_has_place_and_voids():
    field = sampled(Hills(hole=BOUNDS[0] + 240), BOUNDS, 33)
    content = sidecar(field)
    assert content["nodes_without_height"] == 2 * 33
    # Flat, at the height of the nearest node that has one.
    np.testing.assert_array_equal(field.values[:, -2:], field.values[:, [-3, -3]])
    holes = np.asarray(Image.open(io.BytesIO(heightfield.encode_holes(field))))
    assert holes.dtype == np.uint8
    assert (holes[:, -2:] == 255).all()
    assert not holes[:, :-2].any()
    assert content["origin"][:2] == [295500.0, 5629250.0]
    assert (content["crs"], content["vertical_crs"]) == ("EPSG:25832", "EPSG:7837")
    assert (content["size"], content["bounds"]) == ([33, 33], list(BOUNDS))
    assert content["spacing_m"] == [250 / 32, 250 / 32]


def test_nodes_beyond_the_survey_have_no_height_and_do_not_stretch_the_range():
    """The surface goes on beyond the survey, up to 175 m; the covered west ends at 162.5 m."""
    grid = Grid("EPSG:25832", BOUNDS[0], BOUNDS[3], 1.0, 250, 250)
    outside = np.zeros(grid.shape, bool)
    outside[:, 125:] = True
    road = RoadMask(grid, grid, ~outside, outside)
    ramp = Ramp()
    field = sampled(ramp, BOUNDS, 257, road=road)
    x = BOUNDS[0] + np.arange(257) * (250 / 256)
    # The node at 125 m is on the border of a covered cell.
    beyond = x > BOUNDS[0] + 125
    np.testing.assert_array_equal(np.isnan(field.heights), np.tile(beyond, (257, 1)))
    assert (field.low, field.high) == (150, 162.5)
    np.testing.assert_array_equal(field.filled[:, beyond], 162.5)
    assert sidecar(field)["nodes_without_height"] == 128 * 257


def test_flat_surface_is_exact():
    field = sampled(Hills(relief=0), BOUNDS, 33)
    assert not field.values.any()
    content = sidecar(field)
    assert (content["low_m"], content["precision_m"], content["mujoco"]["size"][2]) == (150, 0, 1e-3)


@pytest.mark.parametrize(
    ("spacing", "family", "size"),
    [
        (1.0, "power", 257),
        (250 / 256, "power", 257),
        (0.97, "power", 513),
        (1, "unreal", 253),
        (0.1, "unreal", 4033),
    ],
)
def test_size_at_spacing_is_the_smallest_fine_enough(spacing, family, size):
    assert size_at_spacing(BOUNDS, spacing, family) == size


def test_size_at_spacing_too_fine_names_the_finest():
    with pytest.raises(TaskError, match=r"250 m at 0.01 m need more than 8193 x 8193 .* choose 0.0305 m"):
        size_at_spacing(BOUNDS, 0.01)


def test_sampled_other_size_is_refused():
    with pytest.raises(TaskError, match=r"256 nodes along a side; engines take one of 33, 65, 127"):
        sampled(Hills(), BOUNDS, 256)


def test_sampled_without_heights_is_refused():
    with pytest.raises(TaskError, match="no height within the bounds"):
        sampled(Hills(hole=0), BOUNDS, 33)


def test_sampled_beyond_the_limits_is_refused():
    with pytest.raises(TaskError, match=r"are not within the limits 150 m to 160 m; widen the limits"):
        sampled(Hills(), BOUNDS, 33, (150, 160))
