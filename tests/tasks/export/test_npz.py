import io
import zipfile

import numpy as np
import pytest
from scipy.interpolate import bisplev

from flexroad.tasks.errors import TaskError
from flexroad.tasks.export import npz
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


@pytest.mark.parametrize("from_file", [False, True])
def test_the_same_surface_comes_back(tmp_path, from_file):
    made = surface()
    source = npz.encode(made)
    if from_file:
        path = tmp_path / "tile_surface.npz"
        path.write_bytes(source)
        source = path
    read = npz.decode(source)
    plain = ("crs", "bounds", "degree", "datum", "origin")
    assert [getattr(read, name) for name in plain] == [getattr(made, name) for name in plain]
    for name in ("knots_u", "knots_v", "A", "W"):
        np.testing.assert_array_equal(getattr(read, name), getattr(made, name))
    east, north = WEST + np.linspace(-0.5, 249.5, 40), SOUTH + np.linspace(-0.5, 249.5, 30)
    np.testing.assert_array_equal(read.lattice(east, north), made.lattice(east, north))


def test_arrays_alone_are_enough():
    """What the docstring promises, without any of our code: SciPy evaluates A over W."""
    made = surface()
    with np.load(io.BytesIO(npz.encode(made)), allow_pickle=False) as arrays:
        found = dict(arrays)
    u, v = np.linspace(0, 1, 11), np.linspace(0, 1, 7)
    west, south, east, north = found["bounds"]
    p, q = found["degree"]

    def spline(coefficients):
        return bisplev(v, u, (found["knots_v"], found["knots_u"], coefficients.ravel(), q, p))

    heights = found["datum"] + spline(found["A"]) / spline(found["W"])
    truth = made.lattice(west + u * (east - west), south + v * (north - south))
    np.testing.assert_allclose(heights, truth, rtol=0, atol=1e-9)


def test_equal_surfaces_give_equal_bytes():
    data = npz.encode(surface())
    assert data == npz.encode(surface())
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        assert {info.date_time for info in archive.infolist()} == {(1980, 1, 1, 0, 0, 0)}


def changed(**fields) -> bytes:
    with np.load(io.BytesIO(npz.encode(surface()))) as arrays:
        held = {**arrays, **fields}
    buffer = io.BytesIO()
    np.savez(buffer, **{name: value for name, value in held.items() if value is not None})
    return buffer.getvalue()


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "not a FlexRoad surface"),
        (b"no zip at all", "not a FlexRoad surface"),
        (npz.encode(surface())[:-200], "not a FlexRoad surface"),
        (changed(W=None), "not a FlexRoad surface.*W"),
        (changed(A=np.zeros((9, 11))), r"\(9, 11\).*\(9, 12\)"),
        (changed(version=np.int64(npz.VERSION + 1)), "version 2, known up to 1"),
    ],
)
def test_what_is_no_surface_is_refused_in_one_line(data, message):
    with pytest.raises(TaskError, match=message) as caught:
        npz.decode(data)
    assert "\n" not in str(caught.value)


def test_a_flipped_byte_is_noticed():
    data = bytearray(npz.encode(surface()))
    data[data.index(b"A.npy") + 400] ^= 0xFF
    with pytest.raises(TaskError, match="not a FlexRoad surface"):
        npz.decode(bytes(data))


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(TaskError, match=r"gone\.npz") as caught:
        npz.decode(tmp_path / "gone.npz")
    assert caught.value.file.endswith("gone.npz")


def test_pickled_objects_are_refused():
    with pytest.raises(TaskError, match="not a FlexRoad surface"):
        npz.decode(changed(crs=np.array([{"no": "object"}], dtype=object)))
