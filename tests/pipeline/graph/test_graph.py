"""Fingerprints depend on stage, version, options and inputs, and on nothing else."""

import hashlib
import json
import os
import shutil
import sys
from dataclasses import asdict, replace

import numpy as np
import pytest

from flexroad.catalog import Catalog, Layer
from flexroad.catalog.sources import rasters
from flexroad.pipeline.config.loading import compose, load_config
from flexroad.pipeline.config.stages import STAGE_NAMES, STAGES, stage_head, stage_version
from flexroad.pipeline.graph.graph import Pattern, any_file_missing, layers_read, own_files_missing
from flexroad.pipeline.graph.sources import SourceFiles
from flexroad.tasks.filter import ecsrc
from flexroad.tasks.options import stage_module
from flexroad.tasks.segment import mask, vector
from tests.make_rasters import write

PAPER = {
    "variants": {
        "plane": {"fit": "plane", "sample": "corners"},
        "rgt": {"fit": "raster", "sample": "uniform"},
        "flexroad": {},
    }
}


def graph_of(tile, raw=PAPER, **options):
    return Pattern.of(compose(raw, "x")).graph(tile, **options)


def names(catalog, raw=PAPER, **options) -> dict[str, str]:
    """Return stage -> fingerprint of the first tile."""
    return graph_of(Catalog.read(catalog).tiles[0], raw, **options).variants["flexroad"]


def changed(before: dict[str, str], after: dict[str, str]) -> list[str]:
    """Return the stages whose fingerprints differ."""
    return [stage for stage in STAGE_NAMES if before[stage] != after[stage]]


@pytest.mark.parametrize(
    ("override", "stages"),
    [
        ({"load": {"halo_m": 10}}, list(STAGE_NAMES)),
        ({"ecsrc": {"theta_z_m": 0.1}}, ["ecsrc", "fit", "sample", "evaluate", "assess"]),
        ({"fit": {"degree": 2}}, ["fit", "sample", "evaluate", "assess"]),
        ({"sample": {"road_m": 2}}, ["sample", "evaluate"]),
        ({"evaluate": {"nearest": True}}, ["evaluate"]),
        ({"assess": {"dsm_dtm_tolerance_m": 0.2}}, ["assess"]),
        ({"export": {"formats": ["glb"]}}, []),
        ({"fit": {"method": "nurbs", "degree": 3}}, []),  # the defaults
        ({}, []),
    ],
)
def test_changed_option_changes_its_stage_and_dependents(survey, override, stages):
    assert changed(names(survey), names(survey, {**PAPER, **override})) == stages


def reference_fingerprints(graph, config) -> dict[str, dict[str, str]]:
    """Compute variant -> stage -> fingerprint directly from the definition in `graph.py`."""
    tile, names = graph.tile, {}
    for variant, chain in config.chains.items():
        by_stage = names[variant] = {}
        for stage, inputs in STAGES.items():
            options = chain[stage]
            module = stage_module(options)
            hashed = [
                stage,
                module.VERSION,
                options.model_dump(mode="json"),
                [by_stage[name] for name in inputs] or asdict(tile.grid),
                [source for source in graph.sources if source[0] in getattr(module, "READS", ())],
                [],
            ]
            text = json.dumps(hashed, sort_keys=True, separators=(",", ":"))
            by_stage[stage] = hashlib.sha256(text.encode()).hexdigest()[:32]
    return names


@pytest.mark.parametrize("name", ["paper", "ablation"])
def test_fingerprint_is_hash_of_stage_version_options_and_inputs(name, survey):
    config = load_config(name)
    pattern = Pattern.of(config)
    for tile in Catalog.read(survey).tiles:
        graph = pattern.graph(tile)
        assert graph.variants == reference_fingerprints(graph, config)


def test_changed_version_changes_its_stage_and_dependents(survey, monkeypatch):
    before = names(survey)
    monkeypatch.setattr(ecsrc, "VERSION", ecsrc.VERSION + 1)
    assert changed(before, names(survey)) == ["ecsrc", "fit", "sample", "evaluate", "assess"]


def test_stage_under_another_module_name_keeps_its_fingerprint(survey, monkeypatch):
    before = graph_of(Catalog.read(survey).tiles[0])
    monkeypatch.setitem(sys.modules, "elsewhere", ecsrc)
    monkeypatch.setattr(ecsrc, "__name__", "elsewhere")
    monkeypatch.setattr(ecsrc.Options, "__module__", "elsewhere")
    after = graph_of(Catalog.read(survey).tiles[0])
    moved = after.nodes[after.variants["flexroad"]["ecsrc"]]
    assert stage_module(moved.options).__name__ == "elsewhere"
    assert after == before
    for node, moved in zip(before.nodes.values(), after.nodes.values(), strict=True):
        assert stage_version(moved.stage, moved.options) == stage_version(node.stage, node.options)


def test_variants_share_equal_nodes(survey):
    graph = graph_of(Catalog.read(survey).tiles[0])
    assert len(graph.nodes) == 3 + 3 * 4
    stages = [node.stage for node in graph.nodes.values()]
    assert sorted(set(stages), key=stages.index) == list(STAGE_NAMES)
    for node in graph.nodes.values():
        assert all(i in graph.nodes for i in node.inputs)
    assert [node.stage for node in graph.nodes.values() if not node.stored].count("load") == 1


def test_fingerprint_differs_by_tile_and_not_by_folder(survey, tmp_path):
    tiles = Catalog.read(survey).tiles
    assert graph_of(tiles[0]).fingerprint != graph_of(tiles[1]).fingerprint
    before = names(survey)
    # copytree keeps the file times, and fingerprints hash relative paths.
    moved = shutil.copytree(survey.parent, tmp_path / "moved") / survey.name
    assert names(moved) == before


def test_changed_source_changes_fingerprints_by_time_or_checksum(survey):
    tile = Catalog.read(survey).tiles[0]
    path = tile.paths(tile.layers[0])[0]
    by_time, by_bytes = names(survey), names(survey, checksum=True)
    assert changed(by_time, by_bytes) == list(STAGE_NAMES)
    os.utime(path, (1, 1))
    assert changed(by_time, names(survey)) == list(STAGE_NAMES)
    assert names(survey, checksum=True) == by_bytes
    path.write_bytes(path.read_bytes() + b"\0")
    assert changed(by_bytes, names(survey, checksum=True)) == list(STAGE_NAMES)
    path.unlink()
    missing = names(survey)
    assert changed(by_time, missing) == list(STAGE_NAMES)


def test_changed_layer_changes_only_stages_that_read_it(survey, monkeypatch):
    (tile, *_) = Catalog.read(survey).tiles
    photo = survey.parent / "dop.tif"
    photo.write_bytes(b"old")
    tile = replace(tile, layers=(*tile.layers, Layer("dop", (str(photo),))))

    def fingerprints():
        return graph_of(tile).variants["flexroad"]

    unread = fingerprints()
    photo.write_bytes(b"newer")
    assert fingerprints() == unread
    monkeypatch.setattr(mask, "READS", ("dop",), raising=False)
    read = fingerprints()
    assert changed(unread, read) == list(STAGE_NAMES[1:])
    photo.write_bytes(b"newest of all")
    assert changed(read, fingerprints()) == list(STAGE_NAMES[1:])


def test_changed_model_file_changes_fingerprints_by_checksum(survey, tmp_path, monkeypatch):
    model = tmp_path / "model"
    monkeypatch.setattr(mask, "files", lambda options: (model,), raising=False)
    missing = names(survey)
    model.write_bytes(b"one")
    first = names(survey)
    assert changed(missing, first) == list(STAGE_NAMES[1:])
    os.utime(model, (0, 0))
    assert names(survey) == first
    model.write_bytes(b"two")
    assert changed(first, names(survey)) == list(STAGE_NAMES[1:])


HALO = {**PAPER, "load": {"halo_m": 50}}


def own_and_neighbours(tile, name="dsm"):
    """Return the paths of a layer: the tile's own file, and its neighbours' files."""
    own, *others = tile.paths(tile.layer(name))
    assert own.stem == tile.id
    assert others
    return own, others


def test_neighbours_files_count_only_with_a_halo(survey):
    alone, halo = names(survey), names(survey, HALO)
    _, (beside, *_) = own_and_neighbours(Catalog.read(survey).tiles[0])
    os.utime(beside, (1, 1))
    assert names(survey) == alone
    assert changed(halo, names(survey, HALO)) == list(STAGE_NAMES)


def test_graph_without_halo_holds_only_the_files_of_its_tile(survey):
    tile = Catalog.read(survey).tiles[0]
    graph = graph_of(tile)
    # No stage reads the roads.
    read = [layer for layer in tile.layers if layer.name != "roads"]
    assert set(graph.file_stats) == {str(tile.paths(layer)[0]) for layer in read}
    assert [[name, *(file for file, *_ in files)] for name, files, *_ in graph.sources] == [
        [layer.name, layer.files[0]] for layer in read
    ]

    assert graph.tile == tile.within(tile.grid.bounds)
    # The largest halo of the variants counts.
    for raw in (HALO, {"variants": {"flexroad": {}, "wide": {"load": {"halo_m": 50}}}}):
        wide = graph_of(tile, raw)
        assert wide.tile == tile
        assert len(wide.file_stats) > len(read)


def test_files_of_layers_that_no_stage_reads_may_lie_anywhere(survey):
    (tile, *_) = Catalog.read(survey).tiles
    tile = replace(tile, layers=(*tile.layers, Layer("dop", ("/elsewhere/dop.tif",))))
    graph = graph_of(tile)
    assert "dop" not in {layer.name for layer in graph.readable.layers}
    assert own_files_missing(replace(graph, file_stats={"/missing": None})) == ["/missing"]
    node = graph.nodes[graph.variants["flexroad"]["load"]]
    assert stage_module(node.options).load(graph.readable, node.options).dop is None


def with_photo(tile, folder, *names):
    """Return the tile with photos: the first lies on it, the others beside it."""
    west, south, east, north = tile.grid.bounds
    extents = [(west, south, east, north), (east, south, 2 * east - west, north)]
    for name in names:
        (folder / name).write_bytes(b"old")
    layer = Layer("dop", names, extents=tuple(extents[: len(names)]))
    return replace(tile, root=str(folder), layers=(*tile.layers, layer))


TEXTURED = {**PAPER, "export": {"texture": True}}


@pytest.mark.parametrize("checksum", [False, True])
def test_photo_changes_fingerprint_of_tile_only_as_its_texture(survey, checksum):
    tile = with_photo(Catalog.read(survey).tiles[0], survey.parent, "own.tif", "beside.tif")

    def prints(raw):
        graph = graph_of(tile, raw, checksum=checksum)
        return graph.fingerprint, graph.variants

    plain, textured = prints(PAPER), prints(TEXTURED)
    assert plain[0] != textured[0]
    assert plain[1] == textured[1]
    (survey.parent / "beside.tif").write_bytes(b"newer")
    assert (prints(PAPER), prints(TEXTURED)) == (plain, textured)
    (survey.parent / "own.tif").write_bytes(b"newer")
    assert prints(PAPER) == plain
    newer = prints(TEXTURED)
    assert newer[0] != textured[0]
    assert newer[1] == textured[1]
    (survey.parent / "own.tif").unlink()
    assert prints(TEXTURED)[0] != newer[0]


def test_photo_and_options_of_texture_count_only_for_products_with_a_texture(survey):
    tile = with_photo(Catalog.read(survey).tiles[0], survey.parent, "own.tif")
    graph = graph_of(tile, TEXTURED)
    assert "dop" in graph.reads & layers_read(compose(TEXTURED, "x"))
    assert "dop" not in {layer.name for layer in graph.readable.layers}
    (survey.parent / "own.tif").unlink()
    assert own_files_missing(graph_of(tile, TEXTURED)) == [str(survey.parent / "own.tif")]
    assert own_files_missing(graph_of(tile)) == []

    def fingerprint(**export):
        return graph_of(tile, {**PAPER, "export": export}).fingerprint

    assert fingerprint(texture_px=512) == fingerprint()
    assert fingerprint(texture=True, texture_px=512) != fingerprint(texture=True)


def test_tile_of_a_raster_catalog_depends_on_files_that_reach_it(tmp_path):
    for number, west in enumerate((295500, 295700, 296000)):
        for name in ("dsm", "dtm"):
            width = (200, 300, 250)[number]
            write(tmp_path / name / f"{number}.tif", np.ones((250, width), np.float32), west)
    tiles = rasters.index(tmp_path, {"dsm": "dsm/*.tif", "dtm": "dtm/*.tif"}).tiles

    def read(raw):
        return [[file for file, *_ in graph_of(tile, raw).sources[0][1]] for tile in tiles]

    assert read(PAPER) == [["dsm/0.tif", "dsm/1.tif"], ["dsm/1.tif"], ["dsm/2.tif"]]
    # The halo of the second tile ends where the first file does.
    assert read(HALO) == [["dsm/0.tif", "dsm/1.tif"], ["dsm/1.tif", "dsm/2.tif"], ["dsm/1.tif", "dsm/2.tif"]]


def test_missing_files_around_the_tile_are_not_its_own(survey):
    tile = Catalog.read(survey).tiles[0]
    own, (beside, *_) = own_and_neighbours(tile)
    beside.unlink()
    graph = graph_of(tile, HALO)
    assert any_file_missing(graph)
    assert own_files_missing(graph) == []
    own.unlink()
    assert own_files_missing(graph_of(tile, HALO)) == [str(own)]
    unknown = replace(tile, layers=tuple(replace(layer, extents=()) for layer in tile.layers))
    assert set(own_files_missing(graph_of(unknown, HALO))) == {str(own), str(beside)}


@pytest.mark.parametrize(
    ("name", "files", "end"),
    [
        ("dsm", ("a.tif",), []),
        ("dsm", ("a.tif", "b.tif"), [["joined"]]),
        ("road_mask", ("a.tif", "b.tif"), [["joined"]]),
        ("roads", ("a.gpkg", "b.gpkg"), []),
    ],
)
def test_several_rasters_are_hashed_as_joined_and_one_as_ever(name, files, end, survey):
    layer = Layer(name, files, values=(1,), crs="EPSG:25832")
    tile = replace(Catalog.read(survey).tiles[0], layers=(layer,))
    hashed = json.loads(SourceFiles(tile, lambda path: None, checksum=False).text(layer))
    assert hashed == [name, [[file, None] for file in files], [1], "EPSG:25832", *end]


def test_version_of_levels_enters_fingerprints_only_with_levels(monkeypatch):
    before = stage_head("segment", vector.Options()), stage_head("segment", vector.Options(levels=True))
    monkeypatch.setattr(vector, "LEVELS_VERSION", vector.LEVELS_VERSION + 1)
    assert stage_head("segment", vector.Options()) == before[0]
    assert stage_head("segment", vector.Options(levels=True)) != before[1]
