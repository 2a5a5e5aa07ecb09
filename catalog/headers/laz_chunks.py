"""The chunks of a compressed point cloud: their sizes, checked before they are unpacked.

A chunk of LAS 1.4 begins with its first point, the number of points and the size of each of its layers. The
decoder allocates what these sizes say, up to 4 GiB each.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import BinaryIO

from flexroad.catalog.lazy import lazy

lazrs = lazy("lazrs")

VARIABLE = 2**32 - 1
"""Size of the chunks of COPC: each has its own."""
WHOLE = 0
"""Size of the only chunk of a file that is not divided."""
SHORTEST = 20
"""Length of the shortest chunk (bytes): one point of format 0."""
LAYERED = 3
"""The compressor of LAS 1.4."""
LAYERS = {10: 9, 11: 1, 12: 2, 13: 1}
"""Number of layers by type of item: point, colours, colours with infrared, wave packet."""
BYTES = 14
"""Type of item with one layer per byte: the extra bytes."""


@dataclass(frozen=True)
class Span:
    """Where the points of a file are, and how many its header counts."""

    start: int
    """First byte."""
    size: int
    """Length of the file (bytes)."""
    points: int
    item: int
    """Length of a point, unpacked (bytes)."""


def check(file: BinaryIO, record: bytes, span: Span) -> int:
    """Check the table of chunks, and the sizes at the beginning of each chunk.

    Parameters
    ----------
    file : BinaryIO
        The cloud.
    record : bytes
        The record of its compression.
    span : Span
        Where the points are.

    Returns
    -------
    int
        Number of points that the decoder expects in the largest chunk.

    Raises
    ------
    ValueError
        If a size is not that of a valid file.
    """
    chunk = struct.unpack_from("<I", record, 12)[0]
    items = _items(record)
    if sum(length for _, length in items) != span.item:
        raise ValueError(f"its points have {span.item:,} bytes, but its compression is for other points")
    table = _table(file, record, span)
    counts, lengths = [points for points, _ in table], [length for _, length in table]
    if sum(lengths) > span.size - span.start:
        raise ValueError(f"its chunks have {sum(lengths):,} bytes of {span.size:,}")
    if chunk != WHOLE and span.points > sum(counts):
        raise ValueError(f"its header counts {span.points:,} points, its chunks {sum(counts):,}")
    if struct.unpack_from("<H", record)[0] == LAYERED:
        _check_layers(file, items, span.start, lengths)
    return max(counts, default=0) if chunk == VARIABLE else chunk or span.points


def _items(record: bytes) -> list[tuple[int, int]]:
    """Return type and length (bytes) of each item of a point."""
    count = struct.unpack_from("<H", record, 32)[0]
    return [struct.unpack_from("<HH", record, 34 + 6 * number) for number in range(count)]


def _check_layers(file: BinaryIO, items: list[tuple[int, int]], start: int, lengths: list[int]) -> None:
    first = sum(length for _, length in items) + 4
    layers = sum(length if kind == BYTES else LAYERS.get(kind, 0) for kind, length in items)
    at = start + 8
    for number, length in enumerate(lengths):
        file.seek(at + first)
        head = file.read(4 * layers)
        # Equal, not at most: a decoder that does not use the table goes on where the layers end.
        if length and (
            len(head) < 4 * layers or first + 4 * layers + sum(struct.unpack(f"<{layers}I", head)) != length
        ):
            raise ValueError(f"the layers of chunk {number} do not have its {length:,} bytes")
        at += length


def _table(file: BinaryIO, record: bytes, span: Span) -> list[tuple[int, int]]:
    """Return points and bytes of each chunk."""
    file.seek(span.start)
    position = struct.unpack("<q", file.read(8).ljust(8, b"\0"))[0]
    if position == -1:
        # Written as a stream: the position is at the end.
        file.seek(span.size - 8)
        position = struct.unpack("<q", file.read(8))[0]
    if not span.start < position <= span.size - 8:
        raise ValueError(f"its table of chunks lies at byte {position:,} of {span.size:,}")
    file.seek(position)
    count = struct.unpack("<II", file.read(8))[1]
    # Compressors may add an empty chunk at the end.
    if count > (span.size - span.start) // SHORTEST + 1:
        raise ValueError(f"its table has {count:,} chunks for {span.size - span.start:,} bytes")
    file.seek(span.start)
    table: list[tuple[int, int]] = lazrs.read_chunk_table(file, lazrs.LazVlr(record))
    return table
