import gzip
import io
import re
import tracemalloc
from dataclasses import replace
from datetime import datetime
from xml.etree import ElementTree

import numpy as np
import pytest
from pyproj import CRS

from flexroad.tasks.errors import TaskError
from flexroad.tasks.sample import Options, sample
from flexroad.tasks.types import Mesh
from flexroad.tools.export import landxml
from flexroad.tools.export.landxml import Project
from tests.builders import make_mesh as tile
from tests.crossing import Crossing

WEST, SOUTH = 295500.0, 5629250.0
PROJECT = Project("Aachen", datetime(2026, 5, 4, 3, 2, 1), "EPSG:7837")
SPACE = "{http://www.landxml.org/schema/LandXML-1.2}"


def written(meshes, project=PROJECT, **options) -> bytes:
    file = io.BytesIO()
    landxml.join(file, (landxml.part(mesh, project.joined) for mesh in meshes), project, **options)
    return file.getvalue()


def surfaces(data: bytes) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Return points (easting, northing, height) and faces of each surface, by the LandXML 1.2 schema."""
    read = {}
    for surface in ElementTree.fromstring(data).iter(f"{SPACE}Surface"):
        definition = surface.find(f"{SPACE}Definition")
        assert definition.get("surfType") == "TIN"
        points, index = [], {}
        for p in definition.findall(f"{SPACE}Pnts/{SPACE}P"):
            north, east, up = map(float, p.text.split())
            assert p.get("id") not in index
            index[p.get("id")] = len(points)
            points.append((east, north, up))
        faces = [[index[i] for i in f.text.split()] for f in definition.findall(f"{SPACE}Faces/{SPACE}F")]
        read[surface.get("name")] = np.array(points), np.array(faces)
    return read


def ordered(triangles):
    """Return triangles in an order of their own, so that sets of them can be compared."""
    corners = triangles.reshape(-1, 9)
    return corners[np.lexsort(corners.round(2).T)]


def test_write_two_tiles_reads_back_within_a_tenth_of_a_millimetre():
    meshes = [tile(0), tile(1)]
    read = surfaces(written(meshes))
    assert set(read) == {"road", "ground"}
    for name, road in (("road", True), ("ground", False)):
        truth = np.concatenate([(m.vertices + m.origin)[m.faces[m.road == road]] for m in meshes])
        points, faces = read[name]
        np.testing.assert_allclose(ordered(points[faces]), ordered(truth), rtol=0, atol=1e-4)
    assert set(surfaces(written([tile(road_from=-1)]))) == {"road"}


def test_write_points_are_numbered_from_1_and_all_used():
    for points, faces in surfaces(written([tile(0), tile(1)])).values():
        np.testing.assert_array_equal(np.unique(faces), np.arange(len(points)))
    ids = re.findall(rb'<P id="(\d+)"', written([tile(0, road_from=99.0)]))
    assert list(map(int, ids)) == list(range(1, 26))


@pytest.mark.parametrize("order", [[0, 1, 2, 3], [3, 0, 2, 1], [1, 2, 0, 3]])
def test_write_tiles_share_the_vertices_at_their_borders(order):
    block = [tile(column, row) for column in range(2) for row in range(2)]
    points, faces = surfaces(written([block[k] for k in order], Project("a", PROJECT.written)))["road"]
    assert len(points) == len(np.unique(points, axis=0))
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    unique, uses = np.unique(edges, axis=0, return_counts=True)
    x, y = (points[unique].mean(axis=1)[:, :2] - (WEST, SOUTH)).T
    rim = (x > 19.9) | (y < 0.1) | (y > 19.9) | (x < 5.1)
    np.testing.assert_array_equal(uses[~rim], 2)


@pytest.mark.parametrize(("joined", "shared"), [(False, 0), (True, 5)])
def test_write_tiles_keep_their_own_vertices_unless_they_are_joined(joined, shared):
    data = written(
        [tile(0, road_from=99), tile(1, road_from=99)], Project("a", PROJECT.written, joined=joined)
    )
    points, _ = surfaces(data)["ground"]
    assert len(points) == 2 * 25 - shared


def test_write_step_between_tiles_is_kept():
    low, high = tile(0, road_from=99), tile(1, road_from=99)
    raised = replace(high, vertices=high.vertices + np.array([0, 0, 0.001]))
    points, _ = surfaces(written([low, raised]))["ground"]
    assert len(points) == 2 * 25


def test_write_head_has_units_crs_and_time():
    root = ElementTree.fromstring(written([tile()]))
    assert (root.get("version"), root.get("date"), root.get("time")) == ("1.2", "2026-05-04", "03:02:01")
    units = root.find(f"{SPACE}Units/{SPACE}Metric").attrib
    assert units.items() >= {"linearUnit": "meter", "elevationUnit": "meter"}.items()
    assert (
        root.find(f"{SPACE}CoordinateSystem").attrib.items()
        >= {
            "epsgCode": "25832",
            "name": "ETRS89 / UTM zone 32N",
            "verticalDatum": "Deutsches Haupthoehennetz 2016",
            "verticalCoordinateSystemName": "DHHN2016 height",
        }.items()
    )
    assert root.find(f"{SPACE}Project").get("name") == "Aachen"


def test_write_unknown_heights_have_no_datum_and_a_crs_without_code_is_wkt():
    wkt = CRS.from_proj4("+proj=tmerc +lat_0=50 +lon_0=6 +k=1 +units=m").to_wkt(pretty=True)
    project = Project('<a> & "b"\n', PROJECT.written)
    root = ElementTree.fromstring(written([replace(tile(), crs=wkt)], project))
    assert root.find(f"{SPACE}Project").get("name") == '<a> & "b"\\n'
    system = root.find(f"{SPACE}CoordinateSystem")
    assert (system.get("verticalDatum"), system.get("epsgCode")) == (None, None)
    assert CRS(system.get("ogcWktCode")).equals(CRS(wkt))


def test_write_compressed_has_the_same_text_and_equal_bytes():
    packed = written([tile()], compress=True)
    assert gzip.decompress(packed) == written([tile()])
    assert packed == written([tile()], compress=True)
    assert written([tile()]) == written([tile()])


def test_write_without_meshes_names_the_remedy():
    empty = Mesh(
        "EPSG:25832", (0.0, 0.0, 0.0), np.zeros((0, 3)), np.zeros((0, 3), np.int32), np.zeros(0, bool)
    )
    for meshes in ([], [empty]):
        with pytest.raises(TaskError, match=r"no tile has a mesh with a face; choose an area"):
            written(meshes)


def test_write_two_crs_are_refused():
    with pytest.raises(TaskError, match="EPSG:25832 and EPSG:25833 do not fit"):
        written([tile(), replace(tile(), crs="EPSG:25833")])


@pytest.mark.slow
def test_write_memory_grows_with_the_outline_only(tmp_path):
    def peak(rows: int) -> int:
        with (tmp_path / "run.xml").open("wb") as file:
            tracemalloc.start()
            parts = (landxml.part(tile(c, r, n=9)) for r in range(rows) for c in range(3))
            landxml.join(file, parts, PROJECT, tmp_path)
            _, most = tracemalloc.get_traced_memory()
            tracemalloc.stop()
        return most

    peak(1)
    # An open vertex takes about 450 bytes. All 2,880 at borders of 90 tiles would take 1.3 MB.
    assert peak(30) - peak(2) < 0.5e6


def test_write_decks_are_surfaces_of_their_level():
    meshes = [sample(*t[:3], Options(), t.frame) for t in Crossing((60.0, 30.0)).tiles()]
    read = surfaces(written(meshes))
    assert list(read) == ["road", "ground", "road level 1"]
    for name, number, road in (("road", 0, True), ("ground", 0, False), ("road level 1", 1, True)):
        parts = [mesh.at(number) for mesh in meshes if number in mesh.numbers]
        truth = np.concatenate([(m.vertices + m.origin)[m.faces[m.road == road]] for m in parts])
        points, faces = read[name]
        np.testing.assert_allclose(points[faces], truth, rtol=0, atol=0.6e-4)
    points, _ = read["road level 1"]
    assert len(np.unique(points, axis=0)) == len(points)
