"""``flexroad lift``: files of other programs with heights of tilted ground, and files that are refused."""

import gzip
import os
import resource
import signal
import subprocess
from pathlib import Path

import geopandas
import numpy as np
import pandas as pd
import pyproj
import pytest

from tests import command_line
from tests.faulty_files import FAULTS, Faulty, intercepted
from tests.make_rasters import UTM
from tests.tools.lift.test_opendrive import LINE, document, road
from tests.tools.lift.test_sumo import lane, points
from tests.tools.results.test_command import SOUTH, WEST, ground, made_run

PROJECTED = "+proj=utm +zone=32 +ellps=GRS80"
UTM_HEADER = f'<geoReference>{PROJECTED}</geoReference><offset x="{WEST}" y="{SOUTH}" z="0" hdg="0"/>'


def net(crs: str = PROJECTED, offset: str = f"{-WEST},{-SOUTH}", more: str = "", y: float = 20) -> str:
    """A network of one street from west to east."""
    return (
        f'<net version="1.20"><location netOffset="{offset}" projParameter="{crs}"/>\n'
        + lane("ab", 'from="a" to="b"', f"1,{y} 39,{y}", params=more)
        + "".join(f'<junction id="{i}" x="{x}" y="{y}" shape="{x},{y}"/>\n' for i, x in (("a", 1), ("b", 39)))
        + "</net>\n"
    )


def osm(*places: tuple[float, float], more: str = "") -> str:
    """An OSM file with a street through places of the run (m from its corner)."""
    to_degrees = pyproj.Transformer.from_crs(UTM, "EPSG:4326", always_xy=True)
    degrees = [to_degrees.transform(WEST + x, SOUTH + y) for x, y in places]
    nodes = "".join(
        f'<node id="{i}" lat="{lat:.9f}" lon="{lon:.9f}"/>\n' for i, (lon, lat) in enumerate(degrees, 1)
    )
    refs = "".join(f'<nd ref="{i}"/>' for i in range(1, len(places) + 1))
    way = f'<way id="7">{refs}<tag k="highway" v="residential"/>{more}</way>\n'
    return f'<osm version="0.6">\n{nodes}{way}</osm>\n'


FILES = {
    "net.net.xml": net(),
    "streets.osm": osm((1, 20), (39, 20)),
    "road.xodr": document(road(LINE.replace('x="10"', 'x="1"'), 38.0), header=UTM_HEADER),
}
NOUNS = {".xml": "edge", ".osm": "way", ".xodr": "road"}


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
    return made_run(tmp_path_factory.mktemp("ground"))


@pytest.fixture(params=FILES)
def source(request, tmp_path) -> Path:
    """A file of each format."""
    path = tmp_path / request.param
    path.write_text(FILES[request.param])
    return path


def written(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


def assert_nothing_written(out: Path) -> None:
    """Neither an output nor a temporary file is left beside the input."""
    assert not out.exists()
    assert not [path.name for path in out.parent.iterdir() if path.name.startswith(".")]


def assert_refused(said, out: Path, *words: str) -> None:
    """The command has ended with one line that has some words, and has written nothing."""
    (line,) = said.expected(2).err.splitlines()
    assert line.startswith("error: ")
    for word in words:
        assert word in line
    assert said.out == ""
    assert_nothing_written(out)


def test_lift_writes_the_heights_of_the_ground(run, flexroad, source, tmp_path):
    out, report = tmp_path / "new" / f"out.{source.name}", tmp_path / "lifted.csv"
    said = flexroad("lift", source, run, "-o", out, "--report", report, "--grade-limit", 4).expected(0)
    assert said.out.startswith(f"{out}: 1 {NOUNS[source.suffix]}, 38 m")
    assert said.err == ""
    row = pd.read_csv(report).iloc[0]
    assert row.length_m == pytest.approx(38, abs=0.02)
    assert row.grade_max_percent == pytest.approx(5, abs=0.02)
    assert (row.without_ground_m, row.unknown_deck_m) == (0, 0)
    places = geopandas.read_file(report.with_suffix(".gpkg"))
    assert list(places.kind) == ["grade"]
    place = places.geometry[0]
    assert place.z == pytest.approx(ground(place.x, place.y), abs=2e-3)
    assert {path.name for path in out.parent.iterdir()} == {out.name}


def test_summary_and_notes_say_what_has_no_heights(run, flexroad, tmp_path):
    bridge = '<param key="bridge" value="yes"/>'
    source = written(tmp_path / "n.net.xml", net(more=bridge).replace('39,20"', '139,20"'))
    limit = ["--report", tmp_path / "r.csv", "--crossfall-limit", 2]
    said = flexroad("lift", source, run, "-o", tmp_path / "o.net.xml", *limit).expected(0)
    assert said.out == (
        f"{tmp_path}/o.net.xml: 1 edge, 0.1 km; 99 m beyond the tiles keep their heights; "
        "39 m on decks or in tunnels of unknown height; at most 0 mm from the surface\n"
    )
    notes = said.err.splitlines()
    assert [note.split(":")[0] for note in notes] == ["note"] * 3
    assert "lie beyond the finished tiles and keep their heights (ab)" in notes[0]
    assert "39.2 m of 1 edge are on a deck of unknown height (ab)" in notes[1]
    assert "crossfalls are not known for this format" in notes[2]
    said = flexroad("lift", source, run, "-o", tmp_path / "f.net.xml", "--beyond", "flat").expected(0)
    assert "99 m beyond the tiles go on level" in said.out


def test_wrong_crs_and_places_elsewhere_are_refused(run, flexroad, tmp_path):
    source, out = written(tmp_path / "n.net.xml", net()), tmp_path / "o.net.xml"
    elsewhere = (str(source), "does not lie on the finished tiles", "correct its CRS with --crs and --offset")
    assert_refused(flexroad("lift", source, run, "-o", out, "--crs", "EPSG:25833"), out, *elsewhere)
    assert_refused(flexroad("lift", source, run, "-o", out, "--offset", 0, 0), out, *elsewhere)
    assert_refused(flexroad("lift", source, run, "-o", out, "--crs", "EPSG:0"), out, "PROJ")
    written(source, net(crs="DHDN_UTM"))
    assert_refused(flexroad("lift", source, run, "-o", out), out, str(source), "give another CRS with --crs")


def test_network_without_crs_needs_one(run, flexroad, tmp_path):
    source, out = written(tmp_path / "n.net.xml", net(crs="!")), tmp_path / "o.net.xml"
    assert_refused(flexroad("lift", source, run, "-o", out), out, "carries no CRS", "--crs EPSG:25832")
    flexroad("lift", source, run, "-o", out, "--crs", UTM).expected(0)
    written(source, net(crs="!", offset="0,0"))
    flexroad("lift", source, run, "-o", out, "--crs", UTM, "--offset", WEST, SOUTH).expected(0)
    found = points(out.read_text())
    np.testing.assert_allclose(found[:, 2], ground(WEST + found[:, 0], SOUTH + found[:, 1]), atol=1.5e-3)


def numbers_to_nan(data: bytes) -> bytes:
    for before in (b'"1', b'"39', b" 39", b'lat="5', b'lon="9'):
        data = data.replace(before, before.rstrip(b"0123456789") + b"nan")
    return data


@pytest.mark.parametrize(
    ("change", "words"), [(lambda data: data[:-20], "is not complete XML"), (numbers_to_nan, "")]
)
def test_broken_files_are_refused_in_one_line(run, flexroad, source, tmp_path, change, words):
    source.write_bytes(change(source.read_bytes()))
    out = tmp_path / "out.xml"
    assert_refused(flexroad("lift", source, run, "-o", out), out, str(source), words)


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"", "is of no known format"),
        (b"  0\nSECTION\n", "convert others, such as DXF, with ogr2ogr NEW.gpkg FILE"),
        (b"<svg/>", "has the root element svg; give "),
        (b"BZh91AY&SY", "is compressed with bzip2; unpack it: bunzip2 --keep "),
        (b"\0\0\0\x0d\x0a\x09OSMHeader\x18", "is OSM's PBF; convert it: osmium cat "),
        (b"<osmChange version='0.6'/>", "is a list of changes (osmChange); give the complete file (.osm)"),
        (b"<OpenDRIVE/>", "has no road or feature with coordinates"),
    ],
)
def test_other_files_are_refused_with_the_remedy(run, flexroad, tmp_path, data, words):
    source, out = tmp_path / "a.osm", tmp_path / "o.osm"
    source.write_bytes(data)
    assert_refused(flexroad("lift", source, run, "-o", out, "--crs", UTM), out, f"{source} ", words)


def test_missing_file_and_limits_without_report_are_refused(run, flexroad, source, tmp_path):
    out, missing = tmp_path / "o.xml", tmp_path / "none.osm"
    assert_refused(flexroad("lift", missing, run, "-o", out), out, str(missing))
    said = flexroad("lift", source, run, "-o", out, "--grade-limit", 5)
    assert_refused(said, out, "give --report FILE.csv")


def test_compressed_files_are_copied_and_refused_if_they_are_cut_off(run, flexroad, source, tmp_path):
    packed, out = source.with_name(source.name + ".gz"), tmp_path / f"o.{source.name}.gz"
    packed.write_bytes(gzip.compress(source.read_bytes()))
    flexroad("lift", packed, run, "-o", out).expected(0)
    plain = tmp_path / f"o.{source.name}"
    flexroad("lift", source, run, "-o", plain).expected(0)
    assert gzip.decompress(out.read_bytes()) == plain.read_bytes()
    out.unlink()
    packed.write_bytes(packed.read_bytes()[:-20])
    assert_refused(flexroad("lift", packed, run, "-o", out), out, f"{packed} cannot be read")


def test_output_is_neither_the_input_nor_a_device(run, flexroad, source, tmp_path):
    before = source.read_bytes()
    link = tmp_path / "link.xml"
    link.symlink_to(source)
    for out in (source, link):
        said = flexroad("lift", source, run, "-o", out).expected(2)
        assert f"error: -o {out}: is also {source}; give another name" in said.err
    report = ["--report", source]
    assert "give another name" in flexroad("lift", source, run, "-o", tmp_path / "o", *report).expected(2).err
    (tmp_path / "device.xml").symlink_to("/dev/null")
    said = flexroad("lift", source, run, "-o", tmp_path / "device.xml").expected(2)
    assert len(said.err.splitlines()) == 1
    assert source.read_bytes() == before
    assert Path("/dev/null").is_char_device()


def test_a_full_disk_leaves_what_was_there(run, flexroad, source, tmp_path):
    source.write_text(source.read_text().replace("\n", " " * 200_000 + "\n", 1))
    out = written(tmp_path / "o.xml", "before")
    unlimited = resource.getrlimit(resource.RLIMIT_FSIZE)
    ignored = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, unlimited[1]))
    try:
        said = flexroad("lift", source, run, "-o", out)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, unlimited)
        signal.signal(signal.SIGXFSZ, ignored)
    (line,) = said.expected(2).err.splitlines()
    assert str(out) in line
    assert out.read_text() == "before"
    assert {path.name for path in tmp_path.iterdir()} == {source.name, out.name}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_at_any_operation_leaves_the_whole_copy_or_none(run, flexroad, tmp_path, fault):
    text = net()
    source = written(tmp_path / "n.net.xml", text.replace("\n", " " * 10_000 + "\n", 1))
    flexroad("lift", source, run, "-o", tmp_path / "whole.net.xml").expected(0)
    whole = (tmp_path / "whole.net.xml").read_bytes()
    folder, seen = tmp_path / "out", Faulty(10**9, lambda: None)
    with intercepted(tmp_path / "seen", seen):
        flexroad("lift", source, run, "-o", tmp_path / "seen" / "o.net.xml").expected(0)
    assert len(seen.met) > 3
    codes, out = set(), folder / "o.net.xml"
    for at in range(len(seen.met)):

        def faulty(at=at) -> int:
            with intercepted(folder, FAULTS[fault](at)):
                said = command_line.call("lift", source, run, "-o", out)
            assert len(said.err.splitlines()) == bool(said.code)
            return said.code

        codes.add(command_line.forked(faulty))
        assert not out.exists() or out.read_bytes() == whole
        left = [path.name for path in folder.iterdir()] if folder.exists() else []
        # What a killed process leaves, or cannot remove, is hidden; the next command removes it.
        assert all(name == out.name or name.startswith(".flexroad-") for name in left)
        out.unlink(missing_ok=True)
    # A lock of the temporary folder that cannot be made is no error.
    assert codes in ({2}, {0, 2}, {-signal.SIGKILL})
    flexroad("lift", source, run, "-o", out).expected(0)
    assert [path.name for path in folder.iterdir()] == [out.name]


def large_net(path: Path, size: int) -> None:
    """Write a network of streets in the same place, of some bytes."""
    begin, end = net().split('<edge id="ab"')[0], net()[net().index("<junction") :]
    shape = " ".join(f"{1 + 0.38 * i:.2f},{20 + i % 2 / 10:.2f}" for i in range(101))
    with path.open("w") as file:
        file.write(begin)
        for number in range(size // (2 * len(shape))):
            file.write(lane(f"e{number}", 'from="a" to="b"', shape, shape))
        file.write(end)


def large_osm(path: Path, size: int) -> None:
    """Write an OSM file of some bytes with many nodes and short ways."""
    node, way = osm((20, 20)).splitlines()[1].replace(' id="1"', ""), '<tag k="highway" v="service"/></way>\n'
    number = size // (len(node) + 30)
    with path.open("w") as file:
        file.write('<osm version="0.6">\n')
        file.writelines(f'{node[:5]} id="{i}"{node[5:]}\n' for i in range(1, number))
        for i in range(1, number - 10, 10):
            refs = "".join(f'<nd ref="{i + k}"/>' for k in range(10))
            file.write(f'<way id="{i}">{refs}{way}')
        file.write("</osm>\n")


@pytest.mark.slow
@pytest.mark.parametrize("write", [large_net, large_osm])
def test_memory_does_not_grow_with_the_file(run, tmp_path, write):
    peaks = []
    for size in (10**5, 10**8):
        source, out = tmp_path / "a.xml", tmp_path / "b.xml"
        write(source, size)
        words = ["lift", source, run, "-o", out]
        child = subprocess.Popen([*command_line.PROCESS, *map(str, words)], stdout=subprocess.DEVNULL)
        _, status, used = os.wait4(child.pid, 0)
        child.returncode = os.waitstatus_to_exitcode(status)
        assert child.returncode == 0
        assert out.stat().st_size > source.stat().st_size
        peaks.append(used.ru_maxrss / 1024)
    assert peaks[1] < peaks[0] + 700
