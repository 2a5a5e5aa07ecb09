"""Corners and edges as nodes of the graph: shared by neighbours, changed only by files that reach them."""

import hashlib
import json
import os
import re
import shutil
from collections import Counter, defaultdict
from contextlib import nullcontext
from dataclasses import asdict, replace
from random import Random

import numpy as np
import pytest
import rasterio

from flexroad.catalog import Catalog, Grid, Layer, Tile
from flexroad.catalog.borders import border_of
from flexroad.catalog.sources import rasters
from flexroad.catalog.storage.paths import FileStat
from flexroad.catalog.tile import REACH_M
from flexroad.pipeline.config.loading import compose, load_config
from flexroad.pipeline.config.stages import model_files
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.graph.borders import STAGE, check_tiles
from flexroad.pipeline.graph.graph import Pattern, files_read
from flexroad.pipeline.store.artefacts import ArtefactStore
from flexroad.tasks import load
from flexroad.tasks.border import ENDS, BorderStages
from flexroad.tasks.errors import TaskError
from flexroad.tasks.options import stage_module
from flexroad.tasks.spline.space import Lattice
from flexroad.tools.synthetic import prepared
from flexroad.tools.synthetic.scenes import MADE

PRODUCTION = load_config("production")
SIZE_M = 250


@pytest.fixture(scope="module")
def flat(tmp_path_factory):
    """A prepared survey of 3 x 3 flat tiles of 250 m."""
    folder, tiles = tmp_path_factory.mktemp("flat"), []
    for column in range(3):
        for row in range(3):
            north = 5600000 + (row + 1) * SIZE_M
            grid = Grid("EPSG:25832", 500000 + column * SIZE_M, north, 5.0, 50, 50)
            layers = {"dsm": np.full(grid.shape, 200.0), "dtm": np.full(grid.shape, 200.0)}
            layers["road_mask"] = np.ones(grid.shape, bool)
            tile_id = f"{grid.west:.0f}_{grid.south:.0f}"
            tiles.append(prepared.write_tile(folder, tile_id, grid, layers, date=MADE, dataset="flat"))
    Catalog(tuple(prepared.with_neighbours(tiles))).write(folder / "catalog.json")
    return folder


@pytest.fixture
def survey(flat, tmp_path):
    return shutil.copytree(flat, tmp_path / "survey")


def by_rasters(folder):
    patterns = {name: f"{name}/*.tif" for name in ("dsm", "dtm", "road_mask")}
    return Catalog(rasters.index(folder, patterns, tile_size_m=SIZE_M).tiles)


def by_prepared(folder):
    return Catalog.read(folder / "catalog.json")


CATALOGS = pytest.mark.parametrize("catalog_of", [by_rasters, by_prepared])


def borders(graph):
    return [node for node in graph.nodes.values() if node.stage == STAGE]


def names(catalog, config=PRODUCTION):
    """Return the fingerprints of tiles by id, and of corners and edges by kind and start."""
    tiles, parts = {}, defaultdict(set)
    for graph in map(Pattern.of(config).graph, catalog.tiles):
        tiles[graph.tile.id] = graph.fingerprint
        for node in borders(graph):
            parts[node.border.border.kind, node.border.border.start].add(node.fingerprint)
    return tiles, parts


@CATALOGS
def test_neighbours_share_nodes_of_corners_and_edges(catalog_of, survey):
    _, parts = names(catalog_of(survey))
    assert len(parts) == 16 + 12 + 12
    assert all(len(fingerprints) == 1 for fingerprints in parts.values())
    graph = Pattern.of(PRODUCTION).graph(catalog_of(survey).tiles[0])
    fit = graph.nodes[graph.variants["flexroad"]["fit"]]
    assert [graph.nodes[name].border.border.kind for name in fit.frame] == [
        *["corner"] * 4, "east", "east", "north", "north",
    ]  # fmt: skip
    assert graph.nodes[graph.variants["flexroad"]["sample"]].frame == fit.frame


@pytest.mark.parametrize(
    ("halo_m", "spacing_m", "reach_m"),
    [(0, 3.6, 100), (50, 3.6, 100), (150, 3.6, 150), (300, 3.6, 200), (50, 50, 150)],
)
def test_borders_see_as_far_as_the_halo_and_as_they_act(halo_m, spacing_m, reach_m):
    """Otherwise a tile would bridge a void whose far side its border does not see, or a corner far beyond the
    survey would act on ground within it.
    """
    fit = {"method": "smoothing_spline", "spacing_m": spacing_m}
    config = compose({"fit": fit, "load": {"halo_m": halo_m}}, "reach")
    assert BorderStages.of(config.chains["flexroad"]).reach_m == reach_m


@CATALOGS
def test_changed_file_changes_only_what_it_reaches(catalog_of, survey):
    """The DSM of the middle tile reaches all tiles' halos, and the borders within 100 m of it."""
    tiles, parts = names(catalog_of(survey))
    os.utime(survey / "dsm" / "500250_5600250.tif", (1, 1))
    new_tiles, new_parts = names(catalog_of(survey))
    assert all(new_tiles[tile] != tiles[tile] for tile in tiles)
    changed = {part for part in parts if parts[part] != new_parts[part]}
    inner = {500250.0, 500500.0}, {5600250.0, 5600500.0}
    corners = {("corner", (east, north)) for east in inner[0] for north in inner[1]}
    # Of the middle tile's 4 edges all ground, and of 8 edges the ends reach it.
    eastward = {("east", (east, north)) for east in (500000.0, 500250.0, 500500.0) for north in inner[1]}
    northward = {("north", (east, north)) for east in inner[0] for north in (5600000.0, 5600250.0, 5600500.0)}
    assert changed == corners | eastward | northward


def test_changed_file_at_rim_leaves_far_tiles(survey):
    tiles, parts = names(by_prepared(survey))
    os.utime(survey / "dtm" / "500000_5600000.tif", (1, 1))
    new_tiles, new_parts = names(by_prepared(survey))
    changed = {tile for tile in tiles if tiles[tile] != new_tiles[tile]}
    assert changed == {"500000_5600000", "500250_5600000", "500000_5600250", "500250_5600250"}
    starts = {part[1] for part in parts if parts[part] != new_parts[part]}
    assert max(east for east, _ in starts) <= 500250
    assert max(north for _, north in starts) <= 5600250


@CATALOGS
def test_borders_do_not_depend_on_tiles_in_catalog(catalog_of, survey):
    """A tile that is left out of the run, but whose files exist, changes nothing."""
    whole = catalog_of(survey)
    tiles, parts = names(whole)
    fewer = Catalog(tuple(tile for tile in whole.tiles if tile.id != "500250_5600250"))
    some_tiles, some_parts = names(fewer)
    assert some_tiles.items() <= tiles.items()
    assert all(parts[part] == some_parts[part] for part in some_parts)


def test_options_of_fit_and_filter_change_borders_and_others_do_not(survey):
    catalog = by_prepared(survey)
    _, parts = names(catalog)
    for stage, option, changes in (
        ("fit", {"huber_m": 0.2}, True),
        ("ecsrc", {"shoulder_m": 3}, True),
        ("load", {"halo_m": 20}, False),
        ("load", {"road_height": "dsm"}, True),
        ("sample", {"road_m": 2}, False),
    ):
        raw = {**PRODUCTION.raw, stage: {**PRODUCTION.raw[stage], **option}}
        _, other = names(catalog, compose(raw, "other"))
        assert (other != parts) == changes, stage


def reference_nodes(tile, config, stat_file):
    """Compute the fingerprints of corners and edges directly from the definition in `borders.py`."""

    def described(layer):
        files = [(name, stat_file(path)) for name, path in zip(layer.files, tile.paths(layer), strict=True)]
        how = [["reproject", layer.reproject, layer.height_unit]] if layer.reproject else []
        how += [["joined"]] if len(files) > 1 and layer.name in load.READS else []
        return [
            *(
                layer.name,
                [[name, file.size, file.version] if file else [name, None] for name, file in files],
            ),
            *(list(layer.values), layer.crs, *how),
        ]

    stages = BorderStages.of(config.chains["flexroad"])
    heads = [
        [name, stage_module(options).VERSION, options.model_dump(mode="json")]
        for name, options in stages.by_name.items()
    ]
    found = []
    for number, border in enumerate(border_of(tile.grid, stages.reach_m)):
        ground = tile.around(border.grid, border.within(REACH_M), stages.reads)
        known = all(layer.extents for layer in ground.layers)
        place = [
            border.kind,
            border.start,
            border.tile,
            asdict(border.grid),
            None if known else asdict(tile.grid),
        ]
        ends = [found[end] for end in ENDS[number - 4]] if number >= 4 else []
        models = [hashlib.sha256(path.read_bytes()).hexdigest() for path in model_files(stages.segment)]
        layers = [described(layer) for layer in ground.layers]
        content = [STAGE, load.VERSION, stages.heights, heads, place, ends, layers, models]
        text = json.dumps(content, sort_keys=True, separators=(",", ":"))
        found.append(hashlib.sha256(text.encode()).hexdigest()[:32])
    return found


def scattered(seed):
    """Return a tile whose layers have files of any extent, order and name, some of them missing."""
    random = Random(seed)
    grid = Grid("EPSG:25832", random.choice([500000.0, 0.3, -250.0]), 5600000.3, 1.0, 250, 250)
    west, south, *_ = grid.bounds
    layers = []
    for name in ("dsm", "dtm", "road_height", "dop", "road_mask", "roads"):
        files = random.sample(
            ["b.tif", "a.tif", 'ü"x.tif', "sub/c.tif", "gone.tif", "z.tif"], random.randint(1, 6)
        )
        corners = [(west + random.uniform(-300, 400), south + random.uniform(-300, 400)) for _ in files]
        extents = tuple((x, y, x + random.uniform(1, 400), y + random.uniform(1, 400)) for x, y in corners)
        known = extents if random.random() < 0.9 else ()
        layers.append(Layer(name, tuple(files), (1, 3), None, known, random.random() < 0.3))
    return Tile("t", grid, tuple(layers[:4]), "/data", MADE, nearby=tuple(layers[4:]))


@pytest.mark.parametrize("method", ["mask", "dinov2"])
def test_fingerprint_of_border_is_hash_of_stages_place_ends_files_and_models(method, tmp_path):
    (tmp_path / "model").write_bytes(b"any")
    segment = {"method": method} | ({"model": str(tmp_path / "model")} if method == "dinov2" else {})
    config = compose({**PRODUCTION.raw, "segment": segment}, "x")

    def stat_file(path):
        return None if path.name == "gone.tif" else FileStat(len(str(path)), 7)

    for tile in map(scattered, range(40)):
        graph = Pattern.of(config).graph(tile, stat_file=stat_file)
        assert [node.fingerprint for node in borders(graph)] == reference_nodes(tile, config, stat_file)


def test_fingerprint_of_border_does_not_depend_on_tiles_before():
    """0.0 and -0.0, or 1 and 1.0, are equal numbers, but other texts."""
    layers = (Layer("dsm", ("a.tif",), (), None, ((-300.0, -300.0, 500.0, 500.0),)),)
    tiles = [
        Tile("t", Grid("EPSG:25832", west, 250.0, cell, 250, 250), layers, "/data", MADE)
        for west, cell in ((0.0, 1.0), (-0.0, 1.0), (0.0, 1))
    ]
    for tile in (*tiles, *reversed(tiles)):
        graph = Pattern.of(PRODUCTION).graph(tile, stat_file=lambda path: FileStat(1, 2))
        names = reference_nodes(tile, PRODUCTION, lambda path: FileStat(1, 2))
        assert [node.fingerprint for node in borders(graph)] == names


def test_paper_has_no_borders(survey):
    for graph in map(Pattern.of(load_config("paper")).graph, by_prepared(survey).tiles):
        assert not borders(graph)
        assert not any(node.frame for node in graph.nodes.values())


def test_border_reads_only_files_around_it(survey):
    graph = Pattern.of(PRODUCTION).graph(by_prepared(survey).tiles[0])
    corner = borders(graph)[3]
    assert corner.border.border.start == (500250, 5600250)
    read = {path.relative_to(survey).as_posix() for path in files_read(graph, corner)}
    near = ("500000_5600000", "500000_5600250", "500250_5600000", "500250_5600250")
    assert read == {f"{layer}/{tile}.tif" for layer in ("dsm", "dtm", "road_mask") for tile in near}


def placed(*grids):
    layers = (Layer("dsm", ("dsm.tif",)), Layer("dtm", ("dtm.tif",)))
    return Catalog(tuple(Tile(f"t{k}", grid, layers, "/data", MADE) for k, grid in enumerate(grids)))


def square(west, south, size=250, cell=1.0, crs="EPSG:25832"):
    return Grid(crs, west, south + size * cell, cell, size, size)


OTHERS = {
    "smaller": square(250, 0, 125),
    "finer": square(250, 0, 500, 0.5),
    "shifted along": square(250, 100),
    "overlapping": square(240, 0),
    "coarser": square(250, -125, 125, 2.0),
}


@pytest.mark.parametrize("other", OTHERS.values(), ids=OTHERS)
def test_tiles_that_meet_on_different_lattices_are_refused(other):
    with pytest.raises(ConfigError, match=r"tiles t0 \(250 x 250 cells of 1 m from 0 0\) and t1 \(.*\) meet"):
        check_tiles(PRODUCTION, placed(square(0, 0), other))
    check_tiles(load_config("paper"), placed(square(0, 0), other))


def test_tiles_on_one_lattice_or_apart_are_accepted():
    check_tiles(PRODUCTION, placed(square(0, 0), square(250, 0), square(-500, 750)))
    check_tiles(PRODUCTION, placed(square(0.5, 0.25), square(250.5, 250.25)))
    check_tiles(PRODUCTION, placed(square(0, 0), square(1000, 0, 60)))
    check_tiles(PRODUCTION, placed(square(0, 0), square(100, 0, crs="EPSG:25833")))


BEYOND = r"act farther than the 200 m .*; lower fit\.spacing_m"
CLOSE = r"^fit\.spacing_m is .* m, less than a cell of 1 m; raise it$"


@pytest.mark.parametrize(
    ("spacing_m", "grid", "refused"),
    [
        (60, square(0, 0), ""),
        (80, square(0, 0), BEYOND),
        (80, square(0, 0, 100), ""),
        (0.9, square(0, 0), CLOSE),
        (1e-9, square(0, 0), CLOSE),
        (0.1, square(0, 0, 25, 0.1), ""),
    ],
)
def test_control_points_beyond_listed_files_or_closer_than_cells_are_refused(spacing_m, grid, refused):
    config = compose({"fit": {"method": "smoothing_spline", "spacing_m": spacing_m}}, "x")
    with pytest.raises(ConfigError, match=refused) if refused else nullcontext():
        check_tiles(config, placed(grid))
    if refused == CLOSE:
        with pytest.raises(TaskError, match="less than a cell of 1 m"):
            Lattice.of((250, 250), 1.0, 3, spacing_m)


def test_dry_run_looks_up_shared_nodes_once(survey, flexroad, tmp_path, monkeypatch):
    looked_up = Counter()

    def has(store, node):
        looked_up[node.fingerprint] += 1
        return node.border is not None and node.border.border.kind == "corner"

    monkeypatch.setattr(ArtefactStore, "has", has)
    words = ("--catalog", survey / "catalog.json", "--out", tmp_path / "run", "--dry-run", "-v")
    out = flexroad("run", "--config", "production", "--set", "fit.spacing_m=10", *words).expected(0).out
    assert "  border   16 stored, 24 to do" in out.splitlines()
    # Each of nine tiles lists its own.
    assert len(re.findall(r"^  border   \w+  stored ", out, re.MULTILINE)) == 9 * 4
    assert set(looked_up.values()) == {1}


def test_run_refuses_tiles_of_different_size(made_survey, tmp_path, flexroad):
    tile = Catalog.read(made_survey / "catalog.parquet").tiles[0]
    smaller = replace(tile.grid, west=tile.grid.east, width=30, height=30)
    Catalog((tile, replace(tile, id="smaller", grid=smaller))).write(tmp_path / "mixed.json")
    words = ("--catalog", tmp_path / "mixed.json", "--out", tmp_path / "run")
    (line,) = flexroad("--allow", made_survey, "run", "--config", "production", *words).expected(2).errors
    assert "set fit.method to nurbs, which fits each tile alone" in line


def test_neighbours_share_nodes_where_files_overlap(survey):
    with rasterio.open(survey / "dsm" / "500000_5600000.tif") as file:
        profile = file.profile
    west = {**profile, "width": 60, "transform": profile["transform"]}
    with rasterio.open(survey / "dsm" / "a.tif", "w", **west) as file:
        file.write(np.full((1, 50, 60), 201.0, np.float32))
    # Of two files of the same ground the newest is used; here its time tells.
    os.utime(survey / "dsm" / "a.tif", (1e9, 1e9))
    _, parts = names(by_rasters(survey))
    assert all(len(fingerprints) == 1 for fingerprints in parts.values())
