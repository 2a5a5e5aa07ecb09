import io
import zipfile

import numpy as np
import pytest
from scipy.interpolate import bisplev

from flexroad.catalog.grid import Grid
from flexroad.tasks.errors import TaskError
from flexroad.tasks.products import npz
from flexroad.tasks.spline.stepped import SteppedSurface
from flexroad.tasks.spline.surface import NurbsSurface, clamped_knots

WEST, SOUTH = 295500.5, 5629250.5


def surface(unit_weights: bool = False) -> NurbsSurface:
    rng = np.random.default_rng(3)
    rows, cols = 9, 12
    w = np.ones((rows, cols)) if unit_weights else np.exp(rng.normal(0, 0.3, (rows, cols)))
    return NurbsSurface(
        crs="EPSG:25832",
        bounds=(WEST, SOUTH, WEST + 249.0, SOUTH + 249.0),
        degree=(3, 2),
        knots_u=clamped_knots(cols, 3),
        knots_v=clamped_knots(rows, 2),
        A=w * rng.normal(0, 2, (rows, cols)),
        W=w,
        datum=150.25,
        origin=(295500.0, 5629250.0),
    )


def stepped() -> SteppedSurface:
    cells = Grid("EPSG:25832", WEST, SOUTH + 249.0, 1.0, 249, 249)
    rng = np.random.default_rng(4)
    steps, south_north, west_east = (
        rng.normal(size=shape).astype(np.float32) for shape in (cells.shape, (2, 249), (2, 249))
    )
    return SteppedSurface(
        **vars(surface()), steps=steps, cells=cells, south_north=south_north, west_east=west_east
    )


def test_decode_returns_steps():
    original = stepped()
    restored = npz.decode(npz.encode(original))
    assert isinstance(restored, SteppedSurface)
    assert restored.cells == original.cells
    along = np.linspace(0, 249, 300)
    for x, y in ((along, along), (along, 0), (along, 249), (0, along), (249, along)):
        np.testing.assert_array_equal(
            restored.height(WEST + x, SOUTH + y), original.height(WEST + x, SOUTH + y)
        )


@pytest.mark.parametrize("from_file", [False, True])
def test_decode_returns_encoded_surface(tmp_path, from_file):
    original = surface()
    source = npz.encode(original)
    if from_file:
        path = tmp_path / "tile_surface.npz"
        path.write_bytes(source)
        source = path
    read = npz.decode(source)
    plain = ("crs", "bounds", "degree", "datum", "origin")
    assert [getattr(read, name) for name in plain] == [getattr(original, name) for name in plain]
    for name in ("knots_u", "knots_v", "A", "W"):
        np.testing.assert_array_equal(getattr(read, name), getattr(original, name))
    east, north = WEST + np.linspace(-0.5, 249.5, 40), SOUTH + np.linspace(-0.5, 249.5, 30)
    np.testing.assert_array_equal(read.lattice(east, north), original.lattice(east, north))


def test_encode_arrays_suffice_to_evaluate_surface():
    """SciPy evaluates A / W from the documented arrays, without code of this package."""
    original = surface()
    with np.load(io.BytesIO(npz.encode(original)), allow_pickle=False) as arrays:
        loaded = dict(arrays)
    u, v = np.linspace(0, 1, 11), np.linspace(0, 1, 7)
    west, south, east, north = loaded["bounds"]
    p, q = loaded["degree"]

    def spline(coefficients):
        return bisplev(v, u, (loaded["knots_v"], loaded["knots_u"], coefficients.ravel(), q, p))

    heights = loaded["datum"] + spline(loaded["A"]) / spline(loaded["W"])
    truth = original.lattice(west + u * (east - west), south + v * (north - south))
    np.testing.assert_allclose(heights, truth, rtol=0, atol=1e-9)


def test_encode_equal_surfaces_give_equal_bytes():
    data = npz.encode(surface())
    assert data == npz.encode(surface())
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        assert {info.date_time for info in archive.infolist()} == {(1980, 1, 1, 0, 0, 0)}


def encoded_with(of=None, **fields) -> bytes:
    with np.load(io.BytesIO(npz.encode(of or surface()))) as arrays:
        arrays_and_changes = {**arrays, **fields}
    buffer = io.BytesIO()
    np.savez(buffer, **{name: value for name, value in arrays_and_changes.items() if value is not None})
    return buffer.getvalue()


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "not a FlexRoad surface"),
        (b"no zip at all", "not a FlexRoad surface"),
        (npz.encode(surface())[:-200], "not a FlexRoad surface"),
        (encoded_with(W=None), "not a FlexRoad surface.*W"),
        (
            encoded_with(stepped(), steps=np.zeros((3, 3))),
            r"steps \(\(3, 3\), .* do not fit cells \(249, 249\)",
        ),
        (encoded_with(stepped(), west_east=np.zeros((2, 9))), r"steps .*\(2, 9\)\) do not fit cells"),
        (encoded_with(stepped(), cells=None), "not a FlexRoad surface.*cells"),
        (encoded_with(A=np.zeros((9, 11))), r"\(9, 11\).*\(9, 12\)"),
        (encoded_with(version=np.int64(npz.WITH_LEVELS + 1)), "version 4, this program reads up to 3"),
    ],
)
def test_decode_invalid_data_raises_one_line(data, message):
    with pytest.raises(TaskError, match=message) as caught:
        npz.decode(data)
    assert "\n" not in str(caught.value)


def test_decode_flipped_byte_raises():
    data = bytearray(npz.encode(surface()))
    data[data.index(b"A.npy") + 400] ^= 0xFF
    with pytest.raises(TaskError, match="not a FlexRoad surface"):
        npz.decode(bytes(data))


def test_decode_missing_file_is_named(tmp_path):
    with pytest.raises(TaskError, match=r"gone\.npz") as caught:
        npz.decode(tmp_path / "gone.npz")
    assert caught.value.file.endswith("gone.npz")


def test_decode_pickled_objects_raises():
    with pytest.raises(TaskError, match="not a FlexRoad surface"):
        npz.decode(encoded_with(crs=np.array([{"no": "object"}], dtype=object)))
