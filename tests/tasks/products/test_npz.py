import io
import zipfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays, scalar_dtypes
from scipy.interpolate import bisplev

from flexroad.catalog.grid import Grid
from flexroad.tasks.errors import TaskError
from flexroad.tasks.io import archive
from flexroad.tasks.products import npz
from flexroad.tasks.spline.stepped import SteppedSurface
from flexroad.tasks.spline.surface import NurbsSurface
from tests.builders import make_surface

WEST, SOUTH = 295500.5, 5629250.5


def surface() -> NurbsSurface:
    return make_surface((9, 12), (3, 2))


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


def encoded_with(of=None, **fields) -> bytes:
    with np.load(io.BytesIO(npz.encode(of or surface()))) as arrays:
        arrays_and_changes = {**arrays, **fields}
    buffer = io.BytesIO()
    np.savez(buffer, **{name: value for name, value in arrays_and_changes.items() if value is not None})
    return buffer.getvalue()


def flipped(data: bytes) -> bytes:
    at = data.index(b"A.npy") + 400
    return data[:at] + bytes([data[at] ^ 0xFF]) + data[at + 1 :]


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "not a FlexRoad surface"),
        (b"no zip at all", "not a FlexRoad surface"),
        (npz.encode(surface())[:-200], "not a FlexRoad surface"),
        (flipped(npz.encode(surface())), "not a FlexRoad surface"),
        (encoded_with(crs=np.array([{"no": "object"}], dtype=object)), "not a FlexRoad surface"),
        (Path("gone.npz"), r"gone\.npz"),
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


@given(arrays(scalar_dtypes(), array_shapes(min_dims=0, min_side=0, max_side=300)), st.integers(0, 3))
@example(np.array("Straße"), 1)
@example(np.asfortranarray(np.arange(12.0).reshape(4, 3)), 1)
def test_npz_is_the_zip_of_savez(array, more):
    """`zipfile` reads the names and bytes that it reads of NumPy's own archive, and checks their CRC."""
    written = {f"a{number}.b": array for number in range(more)}
    expected = io.BytesIO()
    np.savez(expected, **written)
    with zipfile.ZipFile(io.BytesIO(archive.npz(written))) as ours, zipfile.ZipFile(expected) as theirs:
        assert ours.testzip() is None
        assert ours.namelist() == theirs.namelist()
        assert all(ours.read(name) == theirs.read(name) for name in ours.namelist())


def test_npz_equal_arrays_give_equal_bytes():
    """Also after other arrays, which might leave something in the compressor's memory."""
    heights = np.random.default_rng(4).normal(size=(250, 250)).round(3)
    first = archive.npz({"a": heights})
    for other in (np.arange(9), np.zeros(10**6), heights.T.astype(np.float32)):
        archive.npz({"b": other})
        assert archive.npz({"a": heights.copy()}) == first
