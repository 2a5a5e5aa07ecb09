"""Which cells of a raster have a value: by its nodata value, its mask, and its alpha band of any type."""

from __future__ import annotations

import contextlib
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rasterio.enums import ColorInterp, MaskFlags


def color_kinds(dataset: Any) -> tuple[ColorInterp, ...]:
    """Return the kind of each band of an open raster, such as grey or alpha."""
    kinds: tuple[ColorInterp, ...]
    # The call raises the last error of GDAL, which may be about a tag that does not matter, and so clears it.
    with contextlib.suppress(Exception):
        kinds = dataset.colorinterp
        return kinds
    kinds = dataset.colorinterp
    return kinds


def alpha_band(dataset: Any) -> int | None:
    """Return the number of an open raster's alpha band that GDAL does not take for a mask, None without one.

    GDAL takes one of uint8 or uint16 alone, and only if the file has no other mask and no nodata value.
    """
    kinds = color_kinds(dataset)
    if ColorInterp.alpha not in kinds[1:] or MaskFlags.alpha in dataset.mask_flag_enums[0]:
        return None
    return int(kinds.index(ColorInterp.alpha, 1)) + 1


def read_valid(dataset: Any, **how: Any) -> Any:
    """Return the first band of an open raster as a masked array; cells without a value are masked.

    - `how`: options of its method `read`, such as ``window``.
    """
    values = dataset.read(1, masked=True, **how)
    alpha = alpha_band(dataset)
    return values if alpha is None else np.ma.masked_where(transparent(dataset, alpha, **how), values)


def transparent(dataset: Any, alpha: int, **how: Any) -> NDArray[np.bool_]:
    """Return the cells without a value by an alpha band; NaN means transparent, too."""
    opaque: NDArray[np.bool_] = dataset.read(alpha, **how) > 0
    return ~opaque
