"""Geometries read from WKB and written to it, against shapely."""

import struct

import pytest
import shapely

from flexroad.tasks.errors import TaskError
from flexroad.tools.lift.shapes import of_wkb, to_wkb

TEXTS = [
    *("POINT (1 2)", "POINT EMPTY", "LINESTRING (1 2, 3 4)", "LINESTRING EMPTY", "POLYGON EMPTY"),
    *("POLYGON ((0 0, 4 0, 4 4, 0 0), (1 1, 2 1, 2 2, 1 1))", "MULTIPOINT ((1 2), (3 4))"),
    *("MULTILINESTRING ((1 2, 3 4), (5 6, 7 8))", "MULTIPOLYGON (((0 0, 4 0, 4 4, 0 0)))"),
    "GEOMETRYCOLLECTION (POINT (1 2), GEOMETRYCOLLECTION (LINESTRING (1 2, 3 4)), POLYGON EMPTY)",
    *("POINT Z (1 2 3)", "LINESTRING Z (1 2 3, 4 5 6)", "LINESTRING M (1 2 3, 4 5 6)", "POINT ZM (1 2 3 4)"),
]


@pytest.mark.parametrize("text", TEXTS)
@pytest.mark.parametrize("form", [{"flavor": "iso"}, {"byte_order": 0}, {"include_srid": True}])
def test_geometry_read_and_written_is_the_same(text, form):
    shape = shapely.from_wkt(text)
    if "include_srid" in form:
        shape = shapely.set_srid(shape, 25832)
    data = shapely.to_wkb(shape, **form)
    assert to_wkb(of_wkb(data)) == shapely.to_wkb(shapely.set_srid(shape, 0), flavor="iso", byte_order=1)


@pytest.mark.parametrize("text", TEXTS)
def test_cut_geometry_is_an_error(text):
    data = shapely.to_wkb(shapely.from_wkt(text))
    for end in range(0, len(data) - 1, 3):
        with pytest.raises(TaskError, match="damaged geometry"):
            of_wkb(data[:end])


def test_geometry_with_a_false_number_of_points_is_an_error():
    with pytest.raises(TaskError, match="damaged geometry"):
        of_wkb(struct.pack("<BII", 1, 2, 2**32 - 1))


def test_collections_too_deep_within_each_other_are_an_error():
    with pytest.raises(TaskError, match="more than 32 collections"):
        of_wkb(struct.pack("<BII", 1, 7, 1) * 1000)


@pytest.mark.parametrize(
    ("code", "name"), [(1009, "CompoundCurve"), (1016, "TIN"), (999, "of the number 999")]
)
def test_curves_and_surfaces_are_an_error_that_names_them(code, name):
    with pytest.raises(TaskError, match=f"has a geometry of the type {name}; write it"):
        of_wkb(struct.pack("<BI", 1, code))
