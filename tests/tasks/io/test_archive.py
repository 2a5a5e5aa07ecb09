import io

import numpy as np

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


def test_npz_equal_arrays_give_equal_bytes():
    assert npz({"a": np.arange(9)}) == npz({"a": np.arange(9)})
