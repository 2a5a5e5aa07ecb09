"""Lazy rasters: Dask arrays whose blocks are read on demand."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flexroad.catalog.lazy import lazy

dask = lazy("dask")
Reader = Callable[[Any], NDArray[Any]]


def lazy_raster(
    read: Reader,
    sources: Mapping[tuple[int, int], Any],
    heights: Sequence[int],
    widths: Sequence[int],
    dtype: Any,
    fill: float,
) -> Any:
    """Return a Dask array whose blocks are read on demand.

    Parameters
    ----------
    read : callable
        Takes a source, returns its block; runs in the threads or processes of the scheduler in use.
    sources : mapping
        The argument of ``read`` by (row, column) of the block; blocks without a source are filled.
    heights, widths : sequence of int
        Rows of each row of blocks, columns of each column of blocks.
    dtype : dtype
        Data type of the array.
    fill : float
        Value of blocks without a source.

    Returns
    -------
    dask.array.Array, (sum(heights), sum(widths))
    """
    block = partial(_block, read, dict(sources), tuple(heights), tuple(widths), np.dtype(dtype), fill)
    return dask.array.map_blocks(
        block, chunks=(tuple(heights), tuple(widths)), dtype=dtype, meta=np.empty((0, 0), dtype)
    )


def _block(
    read: Reader,
    sources: Mapping[tuple[int, int], Any],
    heights: Sequence[int],
    widths: Sequence[int],
    dtype: np.dtype[Any],
    fill: float,
    block_id: tuple[int, int],
) -> NDArray[Any]:
    source = sources.get((block_id[0], block_id[1]))
    if source is None:
        return np.full((heights[block_id[0]], widths[block_id[1]]), fill, dtype)
    return read(source).astype(dtype, copy=False)
