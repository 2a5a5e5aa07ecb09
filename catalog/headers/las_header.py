"""The header of a LAS or LAZ file, checked before a decoder reads it.

Decoders allocate and repeat what the header says: 2^32 - 1 records take hours, a chunk of 2^32 points takes
all memory. Here every count and offset is compared with the size of the file.
"""

from __future__ import annotations

import struct
from pathlib import Path
from typing import BinaryIO

import numpy as np

from flexroad.catalog.grid import FARTHEST
from flexroad.catalog.headers import laz_chunks

SIGNATURE = b"LASF"
LONGEST = 375
"""Length of the header of LAS 1.4 (bytes); LAS 1.0 to 1.2 have 227."""
SHORTEST = 227
COMPRESSED = 0x80
"""Bit of the point format."""
RECORD, EXTENDED_RECORD = 54, 60
"""Length of the headers of a variable length record (VLR) and of an extended one (bytes)."""
LASZIP = 22204, b"laszip encoded"
"""Number and user of the record that describes the compression."""
COARSEST = 1000.0
"""Largest step of coordinates, in any unit."""


def check(path: Path) -> int:
    """Check a header.

    Returns
    -------
    int
        Size of the largest chunk of a compressed file, unpacked (bytes); 0 if the file is not compressed.

    Raises
    ------
    ValueError
        If a number of the header contradicts the size of the file or is no coordinate.
    OSError
        If the file cannot be read.
    """
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
        points, item = _count(head), int(struct.unpack_from("<H", head, 105)[0])
        if points:
            # Files without points have the largest numbers that there are as bounds.
            _check_numbers(head)
        if head[25] >= 4 and len(head) == LONGEST:
            _check_extended(file, head, size)
        if not head[104] & COMPRESSED:
            return 0
        span = laz_chunks.Span(start, size, points, item)
        return item * _largest_chunk(file, length, records, span)


def _count(head: bytes) -> int:
    """Return the number of points: of 64 bits since LAS 1.4."""
    is_long = head[25] >= 4 and len(head) == LONGEST
    return int(struct.unpack_from("<Q", head, 247)[0] if is_long else struct.unpack_from("<I", head, 107)[0])


def _check_numbers(head: bytes) -> None:
    """Check scales, offsets and bounds."""
    numbers = np.frombuffer(head, "<f8", 12, 131)
    scales, offsets, bounds = numbers[:3], numbers[3:6], numbers[6:]
    if not ((scales > 0) & (scales <= COARSEST)).all():
        raise ValueError(f"the scales of its coordinates are {', '.join(f'{scale:g}' for scale in scales)}")
    if not (np.abs(offsets) <= FARTHEST).all():
        raise ValueError(f"the offsets of its coordinates are {', '.join(f'{each:g}' for each in offsets)}")
    if np.isfinite(bounds).all() and (np.abs(bounds) > FARTHEST).any():
        raise ValueError(f"its header gives coordinates up to {np.abs(bounds).max():g}")


def _check_extended(file: BinaryIO, head: bytes, size: int) -> None:
    """Check that the extended records lie in the file."""
    start, records = struct.unpack_from("<QI", head, 235)
    for _ in range(records):
        file.seek(min(start, size))
        record = file.read(EXTENDED_RECORD)
        if len(record) < EXTENDED_RECORD:
            raise ValueError(f"its header counts {records:,} extended records, which end at byte {size:,}")
        start += EXTENDED_RECORD + int(struct.unpack_from("<Q", record, 20)[0])
        if start > size:
            raise ValueError(f"an extended record ends at byte {start:,} of {size:,}")


def _largest_chunk(file: BinaryIO, at: int, records: int, span: laz_chunks.Span) -> int:
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
            sizes.append(laz_chunks.check(file, file.read(length), span))
    if not sizes:
        raise ValueError("it has no record of its compression")
    return max(sizes)
