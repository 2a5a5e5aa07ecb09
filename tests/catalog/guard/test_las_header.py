"""Headers of LAS and LAZ files from others: valid ones of every version are read, absurd ones refused."""

import io
import struct
from pathlib import Path

import laspy
import lazrs
import numpy as np
import pytest

from flexroad.catalog import CatalogError
from flexroad.catalog.scan.point_clouds import chunks, inspect
from tests import fuzz
from tests.make_clouds import write_cloud

N = 3000
FORMATS = {"1.1": (0, 1), "1.2": (2, 3), "1.3": (4, 5), "1.4": (0, 5, 6, 7, 8, 9, 10)}
COUNT, RECORDS, START = 247, 100, 96
"""Bytes of the header of LAS 1.4: numbers of points and of records, and beginning of the points."""
SCALES, OFFSETS, BOUNDS, EXTENDED = 131, 155, 179, 235


def read(path: Path) -> int:
    """Return the number of points, all of them decoded; also in a process of its own."""
    inspect(path)
    return sum(len(part.x) for part in chunks(path, drop=()))


def walk() -> np.ndarray:
    steps = np.random.default_rng(3).integers(-5, 6, (N, 3))
    return np.cumsum(steps, axis=0) / 100 + [356_000, 5_699_000, 50]


def spoil(path: Path, at: int, form: str, *values: float) -> Path:
    data = bytearray(path.read_bytes())
    struct.pack_into(form, data, at, *values)
    path.write_bytes(data)
    return path


def fails(path: Path, match: str) -> None:
    with pytest.raises(CatalogError, match=match) as error:
        read(path)
    assert "\n" not in str(error.value)
    assert str(error.value).startswith(str(path))
    assert str(error.value).endswith("download it again")


@pytest.mark.parametrize("suffix", ["las", "laz"])
@pytest.mark.parametrize(("version", "kind"), [(v, kind) for v, kinds in FORMATS.items() for kind in kinds])
def test_every_version_and_format_is_read(tmp_path, version, kind, suffix):
    header = laspy.LasHeader(point_format=kind, version=version)
    header.scales = [0.01] * 3
    header.add_extra_dim(laspy.ExtraBytesParams("above_ground", "f4"))
    header.add_extra_dim(laspy.ExtraBytesParams("normal", "3u1"))
    points = laspy.LasData(header)
    points.x, points.y, points.z = walk().T
    header.vlrs.append(laspy.VLR("someone", 22204, "not of the compression", b"abc"))
    if version == "1.4":
        points.evlrs = laspy.vlrs.vlrlist.VLRList([laspy.VLR("copc", 1000, "pages", b"abc" * 99)])
    points.write(tmp_path / f"a.{suffix}")
    assert read(tmp_path / f"a.{suffix}") == N


@pytest.mark.parametrize("suffix", ["las", "laz"])
@pytest.mark.parametrize(
    ("at", "form", "values", "match"),
    [
        (RECORDS, "<I", [2**32 - 1], "counts 4,294,967,295 records before its points"),
        (START, "<I", [2**32 - 1], "its points begin at byte 4,294,967,295 of"),
        (EXTENDED, "<QI", [0, 2**32 - 1], "an extended record ends at byte|extended records, which end at"),
        (EXTENDED, "<QI", [2**63, 1], "counts 1 extended records, which end at byte"),
        (COUNT, "<Q", [2**63], "is cut short|counts 9,223,372,036,854,775,808 points, its chunks 50,000"),
        (SCALES, "<d", [np.nan], "the scales of its coordinates are nan, 0.01, 0.01"),
        (SCALES, "<d", [0], "the scales of its coordinates are 0, 0.01, 0.01"),
        (SCALES + 16, "<d", [1e300], r"the scales of its coordinates are 0.01, 0.01, 1e\+300"),
        (OFFSETS, "<d", [np.nan], "the offsets of its coordinates are nan"),
        (OFFSETS + 8, "<d", [-1e300], r"the offsets of its coordinates are .*, -1e\+300"),
        (BOUNDS, "<d", [1e300], r"its header gives coordinates up to 1e\+300"),
        (BOUNDS, "<d", [np.nan], "is damaged: its header gives no bounds"),
        (BOUNDS, "<d", [355_000.0], "is damaged: its header gives "),
        (104, "<B", [63], "cannot be read as a point cloud"),
    ],
)
def test_absurd_number_in_header_raises_one_line(tmp_path, suffix, at, form, values, match):
    fails(spoil(write_cloud(tmp_path / f"a.{suffix}", walk()), at, form, *values), match)


def test_empty_file_with_largest_numbers_as_bounds_has_no_points(tmp_path):
    path = write_cloud(tmp_path / "a.las", np.zeros((0, 3)))
    spoil(path, BOUNDS, "<6d", *[-1.7e308, 1.7e308] * 3)
    with pytest.raises(CatalogError, match="has no points; leave it out"):
        inspect(path)


def test_points_of_absurd_length_are_decoded_few_at_a_time(tmp_path, monkeypatch):
    path = write_cloud(tmp_path / "a.laz", walk())
    monkeypatch.setattr("flexroad.catalog.scan.point_clouds.CHUNK_BYTES", 30 * 1000)
    assert [len(part.x) for part in chunks(path)] == [1000] * 3


@pytest.mark.slow
@pytest.mark.parametrize("suffix", ["las", "laz"])
def test_cloud_damaged_at_random_raises_or_reads(tmp_path, suffix):
    path = write_cloud(tmp_path / f"a.{suffix}", walk(), crs="EPSG:25832", colour=np.full((N, 3), 9))
    fuzz.check(__name__, "read", fuzz.damaged(path.read_bytes(), 200, 1), path)


VARIABLE = 2**32 - 1
CHUNK, ITEMS = 12, 32
"""Bytes of the record of the compression: number of points of a chunk, and of items of a point."""


def start_of(path: Path) -> tuple[int, int]:
    """Return the first byte of the compression's record, and the first byte of the points."""
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
    path = divided(tmp_path / "a.laz", chunk, version=version, kind=kind, streamed=streamed)
    assert read(path) == N
    (whole,) = chunks(path, drop=())
    parts = inspect(path).parts(370)
    assert (len(parts) == 1) == (chunk in (0, 50_000, 2**32 - 2))
    read_apart = [next(chunks(path, N, drop=(), points=part)) for part in reversed(parts)]
    for name in ("x", "y", "z"):
        joined = np.concatenate([getattr(part, name) for part in reversed(read_apart)])
        np.testing.assert_array_equal(joined, getattr(whole, name))


BEYOND = "its table of chunks lies at byte"


@pytest.mark.parametrize(
    ("place", "shift", "form", "value", "match"),
    [
        *[("points", 0, "<q", value, BEYOND) for value in (2**62, -5, 0, "points")],
        ("table", 4, "<I", 2**32 - 1, "its table has 4,294,967,295 chunks for"),
        ("points", 8 + 30 + 4, "<I", 2**32 - 1, "the layers of chunk 0 do not have its"),
        ("record", ITEMS + 4, "<H", 60_000, "its points have 30 bytes, but its compression"),
        ("record", -36, "<H", 1, "it has no record of its compression"),
    ],
)
def test_absurd_number_in_the_compression_raises_one_line(tmp_path, place, shift, form, value, match):
    """Places are relative to the record of the compression, the points or the table of chunks."""
    path = write_cloud(tmp_path / "a.laz", walk())
    places = dict(zip(("record", "points"), start_of(path), strict=True))
    (places["table"],) = struct.unpack_from("<q", path.read_bytes(), places["points"])
    fails(spoil(path, places[place] + shift, form, places.get(value, value)), match)


def test_equal_points_take_almost_no_bytes_and_are_read(tmp_path):
    path = write_cloud(tmp_path / "a.laz", np.zeros((200_000, 3)))
    assert path.stat().st_size < 200_000 / 50
    assert read(path) == 200_000
