import laspy
import numpy as np
import pytest
from laspy.vlrs.known import GeoKeyDirectoryVlr

from flexroad.catalog import CatalogError
from flexroad.catalog.crs import in_plan
from flexroad.catalog.scan.point_clouds import USED, _opened, chunks, find, inspect
from tests.make_clouds import write_cloud

N = 120_000
"""More than one chunk of a LAZ file (50,000 points)."""


def some_points(n=N):
    rng = np.random.default_rng(5)
    return np.round(rng.uniform([636000, 848000, 400], [639000, 853000, 600], (n, 3)), 2)


def joined(path, **options):
    parts = list(chunks(path, **options))
    xyz = np.concatenate([np.stack([part.x, part.y, part.z], axis=1) for part in parts])
    colour = None if parts[0].colour is None else np.concatenate([part.colour for part in parts])
    return xyz, np.concatenate([part.kind for part in parts]), colour


def test_inspect_returns_header_fields(tmp_path):
    xyz = some_points(500)
    path = write_cloud(tmp_path / "a.laz", xyz, crs="EPSG:2994", colour=np.full((500, 3), 9))
    cloud = inspect(path)
    assert (cloud.points, cloud.has_colours, in_plan(cloud.crs)) == (500, True, "EPSG:2994")
    assert cloud.bounds == pytest.approx((*xyz.min(axis=0)[:2], *xyz.max(axis=0)[:2]), abs=1e-6)
    assert cloud.heights == pytest.approx((xyz[:, 2].min(), xyz[:, 2].max()), abs=1e-6)
    plain = inspect(write_cloud(tmp_path / "b.las", xyz))
    assert (plain.has_colours, plain.crs) == (False, None)


@pytest.mark.parametrize("suffix", ["las", "laz"])
def test_chunks_and_parts_of_any_size_give_same_points(tmp_path, suffix):
    rng = np.random.default_rng(6)
    xyz, kind, colour = some_points(), rng.integers(0, 7, N), rng.integers(0, 65536, (N, 3))
    path = write_cloud(tmp_path / f"a.{suffix}", xyz, kind, colour=colour)
    cloud, whole = inspect(path), joined(path)
    assert np.abs(whole[0] - xyz).max() < 1e-6
    for got, expected in zip(whole[1:], (kind, colour), strict=True):
        np.testing.assert_array_equal(got, expected)
    for size in (50_000, 7919):
        for got, expected in zip(joined(path, size=size), whole, strict=True):
            np.testing.assert_array_equal(got, expected)
    for size in (7919, 60_000, 10**6):
        parts = cloud.parts(size)
        assert np.array_equal(np.concatenate(parts), np.arange(N))
        # A compressed chunk of 50,000 points is not decoded for each of its parts.
        assert size == 10**6 or len(parts[0]) == (size if suffix == "las" else max(size, 7 * 7919))
        got = [joined(path, size=5000, drop=(), points=part) for part in parts]
        for k in (0, 1):
            np.testing.assert_array_equal(np.concatenate([part[k] for part in got]), whole[k])


def test_chunks_drop_noise_and_withheld_points(tmp_path):
    kind, withheld = [1, 7, 18, 2, 17], [False, False, False, True, False]
    path = write_cloud(tmp_path / "a.laz", some_points(5), kind, withheld=withheld)
    assert list(joined(path)[1]) == [1, 17]
    assert list(joined(path, drop=())[1]) == [1, 7, 18, 17]


@pytest.mark.parametrize("suffix", ["las", "laz"])
@pytest.mark.parametrize("part", [0.0, 0.0001, 0.3, 0.999])
def test_truncated_file_raises_one_line(tmp_path, suffix, part):
    path = write_cloud(tmp_path / f"a.{suffix}", some_points())
    whole = path.read_bytes()
    path.write_bytes(whole[: int(len(whole) * part)])
    with pytest.raises(CatalogError) as error:
        list(chunks(inspect(path).path))
    assert "\n" not in str(error.value)
    assert str(error.value).startswith(str(path))
    assert str(error.value).endswith("download it again")


@pytest.mark.parametrize("part", [0.2, 0.5, 0.8])
def test_damaged_bytes_raise_error(tmp_path, part):
    """LAZ has no checksum: overwritten bytes end too early, or decode to points far away."""
    rng = np.random.default_rng(3)
    walk = np.cumsum(rng.integers(-5, 6, (N, 3)), axis=0) / 100 + [636000, 848000, 400]
    path = write_cloud(tmp_path / "a.laz", walk)
    spoiled = bytearray(path.read_bytes())
    at = int(len(spoiled) * part)
    spoiled[at : at + 2000] = bytes(2000)
    path.write_bytes(spoiled)
    assert inspect(path).points == N
    with pytest.raises(CatalogError, match=r"a\.laz (is damaged|cannot be read).*; download it again"):
        list(chunks(path))


def test_inspect_not_a_cloud_raises_error(tmp_path):
    with pytest.raises(CatalogError, match="none.laz does not exist; give LAS or LAZ files"):
        inspect(tmp_path / "none.laz")
    text = tmp_path / "a.laz"
    text.write_text("points " * 100)
    with pytest.raises(CatalogError, match="a.laz cannot be read as a point cloud: .*; download it again"):
        inspect(text)
    with pytest.raises(CatalogError, match="empty.laz has no points; leave it out"):
        inspect(write_cloud(tmp_path / "empty.laz", np.zeros((0, 3))))


def test_inspect_user_defined_projection_has_no_crs(tmp_path):
    def with_keys(name, xyz):
        header = laspy.LasHeader(point_format=1, version="1.2")
        header.scales, header.offsets = [1e-4] * 3, xyz[0]
        points = laspy.LasData(header)
        points.x, points.y, points.z = xyz.T
        keys = GeoKeyDirectoryVlr()
        # Version; then model type, geographic base NAD83(HARN), user-defined projection:
        # key, location, count, value.
        values = [1, 1, 0, 3, 1024, 0, 1, 1, 2048, 0, 1, 4152, 3072, 0, 1, 32767]
        keys.parse_record_data(np.array(values, "<u2").tobytes())
        points.header.vlrs.append(keys)
        points.write(tmp_path / name)
        return inspect(tmp_path / name).crs

    assert with_keys("feet.las", some_points(10)) is None
    assert in_plan(with_keys("degrees.las", some_points(10) / [-5200, 20000, 1])) == "EPSG:4152"


def test_find_searches_folders_and_removes_duplicates(tmp_path):
    xyz = some_points(3)
    folder = tmp_path / "clouds"
    paths = [write_cloud(folder / name, xyz) for name in ("b.laz", "c.copc.laz")]
    paths.append((folder / "b.laz").rename(folder / "A.LAZ"))
    (folder / "notes.txt").write_text("none of ours")
    assert [path.name for path in find([folder / "c.copc.laz", folder])] == ["A.LAZ", "c.copc.laz"]
    (tmp_path / "bare").mkdir()
    with pytest.raises(CatalogError, match=r"bare has no point clouds \(.las, .laz\)"):
        find([tmp_path / "bare"])
    with pytest.raises(CatalogError, match="gone.laz does not exist"):
        find([tmp_path / "gone.laz"])


def test_chunks_have_all_fields_that_they_hold_although_others_are_not_decoded(tmp_path):
    rng, xyz = np.random.default_rng(1), some_points(500)
    n, kind = len(xyz), np.arange(500) % 200
    colour, gps = rng.integers(1, 2**16, (n, 3)), 1e8 + rng.random(n)
    file = write_cloud(
        tmp_path / "a.laz", xyz, kind, colour=colour, withheld=rng.random(n) < 0.3, gps=gps, standard=True
    )
    las = laspy.read(file)
    las.intensity = rng.integers(0, 2**16, n)
    las.write(file)
    kept = ~np.asarray(las.withheld, bool)
    got = list(chunks(file, 200, drop=()))
    fields = {"x": las.x, "y": las.y, "z": las.z, "kind": las.classification, "gps": gps}
    for name, expected in fields.items():
        values = np.concatenate([getattr(chunk, name) for chunk in got])
        np.testing.assert_array_equal(values, np.asarray(expected)[kept])
    np.testing.assert_array_equal(np.concatenate([chunk.colour for chunk in got]), colour[kept])
    with _opened(file, USED) as reader:
        assert (reader.read_points(n).intensity != las.intensity).any()
