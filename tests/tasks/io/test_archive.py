import io
import zipfile

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays, scalar_dtypes

from flexroad.tasks.io.archive import npz


def test_npz_reads_back_with_numpy():
    arrays = {
        "name": np.array("Straße"),
        "number": np.int64(3),
        "empty": np.empty((0, 3)),
        "columns": np.asfortranarray(np.arange(12.0).reshape(4, 3)),
    }
    with np.load(io.BytesIO(npz(arrays)), allow_pickle=False) as archive:
        assert archive.files == list(arrays)
        for name, array in arrays.items():
            np.testing.assert_array_equal(archive[name], array)
            assert archive[name].dtype == np.asarray(array).dtype


@given(arrays(scalar_dtypes(), array_shapes(min_dims=0, min_side=0, max_side=300)), st.integers(0, 3))
def test_npz_is_the_zip_of_savez(array, more):
    """`zipfile` reads the names and bytes that it reads of NumPy's own archive, and checks their CRC."""
    written = {f"a{number}.b": array for number in range(more)}
    expected = io.BytesIO()
    np.savez(expected, **written)
    with zipfile.ZipFile(io.BytesIO(npz(written))) as ours, zipfile.ZipFile(expected) as theirs:
        assert ours.testzip() is None
        assert ours.namelist() == theirs.namelist()
        assert all(ours.read(name) == theirs.read(name) for name in ours.namelist())


def test_npz_equal_arrays_give_equal_bytes():
    """Also after other arrays, which might leave something in the compressor's memory."""
    heights = np.random.default_rng(4).normal(size=(250, 250)).round(3)
    first = npz({"a": heights})
    for other in (np.arange(9), np.zeros(10**6), heights.T.astype(np.float32)):
        npz({"b": other})
        assert npz({"a": heights.copy()}) == first
