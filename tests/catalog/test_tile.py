"""Which files of a tile reach which ground."""

from dataclasses import replace
from datetime import UTC, datetime

import pytest
from hypothesis import given
from hypothesis import strategies as st

from flexroad.catalog import LAYERS, Grid, Layer, Tile
from flexroad.catalog.grid import overlap
from flexroad.catalog.tile import BORDER_LAYERS, LOADED, by_cover
from flexroad.tasks import load

GRID = Grid("EPSG:25832", 0.0, 100.0, 1.0, 100, 100)
OWN, EAST, FAR = (0.0, 0.0, 100.0, 100.0), (100.0, 0.0, 200.0, 100.0), (250.0, 0.0, 300.0, 100.0)
THREE = Layer("dsm", ("own", "east", "far"), (), None, (OWN, EAST, FAR))


def tile(layers, nearby=(), grid=GRID) -> Tile:
    return Tile("0_0", grid, tuple(layers), "", datetime(2020, 5, 1, tzinfo=UTC), nearby=tuple(nearby))


def named(name, layer=THREE, **changes) -> Layer:
    return replace(layer, name=name, **changes)


@pytest.mark.parametrize(
    ("bounds", "files"),
    [
        (OWN, ("own",)),
        ((0.0, 0.0, 100.0005, 100.0), ("own",)),
        ((0.0, 0.0, 100.01, 100.0), ("own", "east")),
        ((99.0, 99.0, 260.0, 200.0), ("own", "east", "far")),
        ((260.0, 10.0, 270.0, 20.0), ("far",)),
        ((0.0, 100.0, 300.0, 200.0), ()),
    ],
)
def test_reaching_keeps_files_that_overlap_and_all_of_unknown_extents(bounds, files):
    kept = THREE.reaching(bounds)
    extents = tuple(THREE.extents[THREE.files.index(file)] for file in files)
    assert kept == (replace(THREE, files=files, extents=extents) if files else None)
    unknown = replace(THREE, extents=())
    assert unknown.reaching(bounds) is unknown


def test_loaded_layers_are_those_that_load_reads():
    assert set(LOADED) == set(load.READS)
    assert set(LOADED) | set(BORDER_LAYERS) == set(LAYERS)


def test_within_limits_rasters_but_not_photo_and_roads():
    limited = tile(map(named, LAYERS)).within(OWN)
    assert {layer.name: len(layer.files) for layer in limited.layers} == {
        name: 3 if name in ("dop", "roads") else 1 for name in LAYERS
    }
    assert limited.grid == GRID
    nowhere = tile([THREE]).within((0.0, 500.0, 10.0, 510.0))
    assert nowhere.layers == (THREE,)


def test_by_cover_separates_layers_that_only_come_near():
    beside = named("dtm", files=("east",), extents=(EAST,))
    unknown, roads = named("dop", extents=()), named("roads", beside)
    sliver = named("reference", files=("sliver",), extents=((99.995, 0.0, 200.0, 100.0),))
    layers = [THREE, beside, unknown, sliver, roads]
    assert by_cover(layers, GRID) == ((THREE, unknown, roads), (beside, sliver))


STRIP = Grid("EPSG:25832", 90.0, 60.0, 1.0, 20, 20)
"""Ground on both sides of the border between OWN and EAST."""


def test_around_is_equal_from_both_sides():
    """The western tile has a terrain model and lists its own file first; the eastern one has a photo."""
    masks = {"values": (1, 3), "crs": "EPSG:25832"}
    west = tile(
        [named("dsm"), named("dtm", files=("own",), extents=(OWN,)), named("road_mask", **masks)],
        [named("dop", files=("east",), extents=(EAST,))],
    )
    back = {"files": ("east", "far", "own"), "extents": (EAST, FAR, OWN)}
    east = tile(
        [
            named("dsm", **back),
            named("dop", files=("east",), extents=(EAST,)),
            named("road_mask", **back, **masks),
        ],
        [named("dtm", files=("own",), extents=(OWN,))],
        Grid("EPSG:25832", 100.0, 100.0, 1.0, 100, 100),
    )
    reach = STRIP.buffered(50).bounds
    strip = west.around(STRIP, reach)
    assert strip.layers == east.around(STRIP, reach).layers
    assert [(layer.name, layer.files, layer.values, layer.crs) for layer in strip.layers] == [
        ("dsm", ("east", "own"), (), None),
        ("dtm", ("own",), (), None),
        ("dop", ("east",), (), None),
        ("road_mask", ("east", "own"), (1, 3), "EPSG:25832"),
    ]
    assert (strip.id, strip.grid, strip.nearby) == (west.id, STRIP, ())


def test_around_leaves_out_layers_out_of_reach_and_those_of_the_evaluation():
    whole = tile(map(named, LAYERS), [])
    assert [layer.name for layer in whole.around(STRIP, STRIP.bounds).layers] == list(BORDER_LAYERS)
    beyond = Grid("EPSG:25832", 210.0, 60.0, 1.0, 20, 20)
    strip = whole.around(beyond, (210.0, 40.0, 260.0, 60.0))
    assert [(layer.name, layer.files) for layer in strip.layers] == [("dop", ("far",)), ("roads", ("far",))]


@given(st.permutations(range(5)), st.permutations(range(5)))
def test_common_order_is_by_name_unless_files_overlap(first, second):
    """Of 0, 1 and 2, which overlap, the newest comes first; 3 and 4 lie beside them."""
    extents = (OWN, OWN, (50.0, 0.0, 150.0, 100.0), (150.0, 0.0, 200.0, 100.0), FAR)
    names = ("b_2018", "b_2020", "c_2022", "a", "d")
    orders = []
    for order in (first, second):
        stacked = iter([2, 1, 0])
        kept = [number if number > 2 else next(stacked) for number in order]
        layer = Layer("dsm", tuple(names[k] for k in kept), (), None, tuple(extents[k] for k in kept))
        orders.append(layer.part(layer.in_common_order((0.0, 0.0, 300.0, 100.0))))
        touched = layer.part(layer.in_common_order((120.0, 0.0, 130.0, 100.0)))
        assert touched.files == ("c_2022",)
    assert orders[0] == orders[1]
    assert orders[0].files == ("a", "c_2022", "b_2020", "b_2018", "d")


def test_files_around_a_tile_are_compared_once_for_all_layers(monkeypatch):
    compared, side = [], 15

    def counted(one, other, tolerance=0.0):
        compared.append(one)
        return overlap(one, other, tolerance)

    monkeypatch.setattr("flexroad.catalog.tile.overlap", counted)
    corners = [(20.0 * col, 20.0 * row) for col in range(side) for row in range(side)]
    extents = tuple((west, south, west + 20, south + 20) for west, south in corners)
    names = tuple(f"{number:03}" for number in reversed(range(len(extents))))
    for layer in (Layer(name, names, (), None, extents) for name in LAYERS[:4]):
        for place in range(8):
            west = 100.0 + 20 * place
            numbers = layer.in_common_order((west - 30, 100.0, west + 30, 120.0))
            found = [(west + step, 100.0) for step in (20, 0, -20, -40)]
            assert [corners[number] for number in numbers] == found
    assert len(compared) < 20 * len(extents)
