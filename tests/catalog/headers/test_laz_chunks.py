"""Chunks of compressed clouds: every valid division is read, absurd tables and sizes are one line."""

import io
import struct
from pathlib import Path

import laspy
import lazrs
import numpy as np
import pytest

from tests.catalog.headers.test_las_header import N, fails, read, spoil, walk
from tests.make_clouds import write_cloud

VARIABLE = 2**32 - 1
CHUNK, ITEMS = 12, 32
"""Bytes of the record of the compression: number of points of a chunk, and of items of a point."""


def start_of(path: Path) -> tuple[int, int]:
    """Return the first byte of the record of the compression, and that of the points."""
    with laspy.open(path) as reader:
        record = reader.header.vlrs.get("LasZipVlr")[0].record_data
        return path.read_bytes().find(record), reader.header.offset_to_point_data


def divided(path: Path, chunk: int, *, version: str, kind: int, streamed: bool = False) -> Path:
    """Write a cloud in chunks of ``chunk`` points, by other means than laspy, which has 50,000."""
    header = laspy.LasHeader(point_format=kind, version=version)
    header.scales = [0.01] * 3
    points = laspy.LasData(header)
    points.x, points.y, points.z = walk().T
    points.write(path)
    data, (at, start) = path.read_bytes(), start_of(path)
    record = bytearray(lazrs.LazVlr.new_for_compression(kind, 0).record_data())
    struct.pack_into("<I", record, CHUNK, chunk)
    out = io.BytesIO()
    out.write(data[:at] + record + data[at + len(record) : start])
    compressor = lazrs.LasZipCompressor(out, lazrs.LazVlr(bytes(record)))
    for part in np.array_split(points.points.array, 3):
        compressor.compress_many(np.frombuffer(part.tobytes(), np.uint8))
        if chunk == VARIABLE:
            compressor.finish_current_chunk()
    compressor.done()
    written = out.getvalue()
    if streamed:
        table = written[start : start + 8]
        written = written[:start] + b"\xff" * 8 + written[start + 8 :] + table
    path.write_bytes(written)
    return path


@pytest.mark.parametrize(("version", "kind"), [("1.2", 1), ("1.4", 6)])
@pytest.mark.parametrize(
    ("chunk", "streamed"),
    [(100, False), (777, False), (50_000, True), (VARIABLE, False), (2**32 - 2, False), (0, False)],
)
def test_any_division_into_chunks_is_read(tmp_path, version, kind, chunk, streamed):
    assert read(divided(tmp_path / "a.laz", chunk, version=version, kind=kind, streamed=streamed)) == N


def test_equal_points_take_almost_no_bytes_and_are_read(tmp_path):
    path = write_cloud(tmp_path / "a.laz", np.zeros((200_000, 3)))
    assert path.stat().st_size < 200_000 / 50
    assert read(path) == 200_000


def test_table_beyond_the_file_raises(tmp_path):
    path = write_cloud(tmp_path / "a.laz", walk())
    _, start = start_of(path)
    for position in (2**62, -5, 0, start):
        fails(spoil(path, start, "<q", position), "its table of chunks lies at byte")


def test_table_of_too_many_chunks_raises(tmp_path):
    path = write_cloud(tmp_path / "a.laz", walk())
    _, start = start_of(path)
    table = struct.unpack_from("<q", path.read_bytes(), start)[0]
    fails(spoil(path, table + 4, "<I", 2**32 - 1), "its table has 4,294,967,295 chunks for")


def test_layer_of_4_gib_raises(tmp_path):
    path = write_cloud(tmp_path / "a.laz", walk())
    _, start = start_of(path)
    fails(spoil(path, start + 8 + 30 + 4, "<I", 2**32 - 1), "the layers of chunk 0 do not have its")


def test_compression_of_other_points_raises(tmp_path):
    path = write_cloud(tmp_path / "a.laz", walk())
    at, _ = start_of(path)
    fails(spoil(path, at + ITEMS + 4, "<H", 60_000), "its points have 30 bytes, but its compression")


def test_missing_record_of_compression_raises(tmp_path):
    path = write_cloud(tmp_path / "a.laz", walk())
    at, _ = start_of(path)
    fails(spoil(path, at - 36, "<H", 1), "it has no record of its compression")
