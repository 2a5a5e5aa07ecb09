"""NumPy archives (``.npz``) whose compression is worth its time."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike

LEVEL = 1
"""Level of deflate, 1 to 9. NumPy's own, 6, takes eight times as long for faces, which get no smaller."""


def npz(arrays: Mapping[str, ArrayLike]) -> bytes:
    """Return arrays as a compressed archive that `numpy.load` reads without pickle.

    Equal arrays give equal bytes.
    """
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED, compresslevel=LEVEL) as archive:
        for name, array in arrays.items():
            with archive.open(f"{name}.npy", "w") as entry:
                np.lib.format.write_array(entry, np.asanyarray(array), allow_pickle=False)
    return buffer.getvalue()
