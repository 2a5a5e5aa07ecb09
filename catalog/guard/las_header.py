"""The header of a LAS or LAZ file, checked before a decoder reads it.

Decoders trust the header: 2^32 - 1 records take hours, a chunk of 2^32 points takes all memory. Here every
count and offset is compared with the size of the file.

A chunk of a compressed LAS 1.4 begins with its first point, the number of points and the size of each of its
layers. The decoder allocates what these sizes say, up to 4 GiB each.
"""

from __future__ import annotations

import struct
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np

from flexroad.catalog.grid import FARTHEST
from flexroad.catalog.lazy import lazy

lazrs = lazy("lazrs")

SIGNATURE = b"LASF"
LONGEST = 375
"""Length of the header of LAS 1.4 (bytes); LAS 1.0 to 1.2 have 227."""
SHORTEST = 227
COMPRESSED = 0x80
"""Bit of the point format that marks compressed points."""
RECORD, EXTENDED_RECORD = 54, 60
"""Length of the headers of a variable length record (VLR) and of an extended one (bytes)."""
LASZIP = 22204, b"laszip encoded"
"""Number and user of the record that describes the compression."""
COARSEST = 1000.0
"""Largest step of coordinates, in any unit."""
VARIABLE = 2**32 - 1
"""Chunk size in the header of COPC: each chunk has its own size."""
WHOLE = 0
"""Size of the only chunk of a file that is not divided."""
SHORTEST_CHUNK = 20
"""Length of the shortest chunk (bytes): one point of format 0."""
LAYERED = 3
"""The compressor of LAS 1.4."""
LAYERS = {10: 9, 11: 1, 12: 2, 13: 1}
"""Number of layers by type of item: point, colours, colours with infrared, wave packet."""
BYTES = 14
"""Type of item with one layer per byte: the extra bytes."""


class _Span(NamedTuple):
    """Where the points of a file are, and their number by the header."""

    start: int
    """First byte."""
    size: int
    """Length of the file (bytes)."""
    points: int
    item: int
    """Length of a point, unpacked (bytes)."""


def check(path: Path) -> int:
    """Check a header; return the unpacked size of the largest chunk (bytes), 0 if nothing is compressed."""
    size = path.stat().st_size
    with path.open("rb") as file:
        head = file.read(LONGEST)
        if head[:4] != SIGNATURE or len(head) < SHORTEST:
            raise ValueError("it does not begin as a LAS file")
        length, start, records = struct.unpack_from("<HII", head, 94)
        if not SHORTEST <= length <= start <= size:
            raise ValueError(f"its points begin at byte {start:,} of {size:,}, after a header of {length}")
        if records * RECORD > start - length:
            raise ValueError(f"its header counts {records:,} records before its points at byte {start:,}")
        # The number of points has 64 bits since LAS 1.4.
        is_long = head[25] >= 4 and len(head) == LONGEST
        number = struct.unpack_from(*(("<Q", head, 247) if is_long else ("<I", head, 107)))
        points, item = int(number[0]), int(struct.unpack_from("<H", head, 105)[0])
        if points:
            # Files without points have the largest possible numbers as bounds.
            _check_numbers(head)
        if is_long:
            _check_extended(file, head, size)
        if not head[104] & COMPRESSED:
            return 0
        span = _Span(start, size, points, item)
        return item * _largest_chunk(file, length, records, span)


def _check_numbers(head: bytes) -> None:
    numbers = np.frombuffer(head, "<f8", 12, 131)
    scales, offsets, bounds = numbers[:3], numbers[3:6], numbers[6:]
    if not ((scales > 0) & (scales <= COARSEST)).all():
        raise ValueError(f"the scales of its coordinates are {', '.join(f'{scale:g}' for scale in scales)}")
    if not (np.abs(offsets) <= FARTHEST).all():
        raise ValueError(f"the offsets of its coordinates are {', '.join(f'{each:g}' for each in offsets)}")
    if np.isfinite(bounds).all() and (np.abs(bounds) > FARTHEST).any():
        raise ValueError(f"its header gives coordinates up to {np.abs(bounds).max():g}")


def _check_extended(file: BinaryIO, head: bytes, size: int) -> None:
    start, records = struct.unpack_from("<QI", head, 235)
    for _ in range(records):
        file.seek(min(start, size))
        record = file.read(EXTENDED_RECORD)
        if len(record) < EXTENDED_RECORD:
            raise ValueError(f"its header counts {records:,} extended records, which end at byte {size:,}")
        start += EXTENDED_RECORD + int(struct.unpack_from("<Q", record, 20)[0])
        if start > size:
            raise ValueError(f"an extended record ends at byte {start:,} of {size:,}")


def _largest_chunk(file: BinaryIO, at: int, records: int, span: _Span) -> int:
    """Check the chunks of a compressed file; return the number of points of the largest."""
    sizes = []
    for _ in range(records):
        file.seek(at)
        head = file.read(RECORD)
        user, number, length = struct.unpack_from("<16sHH", head, 2)
        at += RECORD + length
        if at > span.start:
            raise ValueError(
                f"a record ends at byte {at:,}, after the beginning of the points at {span.start:,}"
            )
        if (number, user.partition(b"\0")[0]) == LASZIP:
            sizes.append(_check_chunks(file, file.read(length), span))
    if not sizes:
        raise ValueError("it has no record of its compression")
    return max(sizes)


def _check_chunks(file: BinaryIO, record: bytes, span: _Span) -> int:
    """Check the table of chunks, and the sizes at the beginning of each chunk.

    Return the number of points that the decoder expects in the largest chunk.
    """
    chunk = struct.unpack_from("<I", record, 12)[0]
    # Type and length (bytes) of each item of a point.
    number = struct.unpack_from("<H", record, 32)[0]
    items = [struct.unpack_from("<HH", record, 34 + 6 * place) for place in range(number)]
    if sum(length for _, length in items) != span.item:
        raise ValueError(f"its points have {span.item:,} bytes, but its compression is for other points")
    table = _chunk_table(file, record, span)
    counts, lengths = [points for points, _ in table], [length for _, length in table]
    if sum(lengths) > span.size - span.start:
        raise ValueError(f"its chunks have {sum(lengths):,} bytes of {span.size:,}")
    if chunk != WHOLE and span.points > sum(counts):
        raise ValueError(f"its header counts {span.points:,} points, its chunks {sum(counts):,}")
    if struct.unpack_from("<H", record)[0] == LAYERED:
        _check_layers(file, items, span.start, lengths)
    return max(counts, default=0) if chunk == VARIABLE else chunk or span.points


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


def _chunk_table(file: BinaryIO, record: bytes, span: _Span) -> list[tuple[int, int]]:
    """Return points and bytes of each chunk."""
    file.seek(span.start)
    position = struct.unpack("<q", file.read(8).ljust(8, b"\0"))[0]
    if position == -1:
        # The file was written as a stream: the position is at the end.
        file.seek(span.size - 8)
        position = struct.unpack("<q", file.read(8))[0]
    if not span.start < position <= span.size - 8:
        raise ValueError(f"its table of chunks lies at byte {position:,} of {span.size:,}")
    file.seek(position)
    count = struct.unpack("<II", file.read(8))[1]
    # Compressors may add an empty chunk at the end.
    if count > (span.size - span.start) // SHORTEST_CHUNK + 1:
        raise ValueError(f"its table has {count:,} chunks for {span.size - span.start:,} bytes")
    file.seek(span.start)
    table: list[tuple[int, int]] = lazrs.read_chunk_table(file, lazrs.LazVlr(record))
    return table
