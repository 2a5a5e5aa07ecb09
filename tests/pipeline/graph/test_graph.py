"""Fingerprints change with what makes a result, and with nothing else."""

import hashlib
import json
import os
import shutil
import sys
from dataclasses import asdict, replace

import pytest

from flexroad.catalog import Catalog, Layer
from flexroad.pipeline.config.loading import compose, load_config
from flexroad.pipeline.graph.graph import Pattern, tile_graph
from flexroad.pipeline.graph.stages import STAGE_NAMES, STAGES, stage_module, stage_version
from flexroad.tasks.filter import ecsrc
from flexroad.tasks.segment import mask

PAPER = {
    "variants": {
        "plane": {"fit": "plane", "sample": "corners"},
        "rgt": {"fit": "raster", "sample": "uniform"},
        "flexroad": {},
    }
}


def names(catalog, raw=PAPER, variant="flexroad", **how) -> dict[str, str]:
    return tile_graph(Catalog.read(catalog).tiles[0], compose(raw, "x"), **how).variants[variant]


def changed(before: dict[str, str], after: dict[str, str]) -> list[str]:
    return [stage for stage in STAGE_NAMES if before[stage] != after[stage]]


def test_the_same_again_is_the_same(survey):
    assert names(survey) == names(survey)


@pytest.mark.parametrize(
    ("override", "stages"),
    [
        ({"load": {"halo_m": 10}}, list(STAGE_NAMES)),
        ({"ecsrc": {"theta_z_m": 0.1}}, ["ecsrc", "fit", "sample", "evaluate", "assess"]),
        ({"fit": {"degree": 2}}, ["fit", "sample", "evaluate", "assess"]),
        ({"sample": {"road_m": 2}}, ["sample", "evaluate"]),
        ({"evaluate": {"nearest": True}}, ["evaluate"]),
        ({"assess": {"agree_m": 0.2}}, ["assess"]),
        ({"export": {"formats": ["glb"]}}, []),
    ],
)
def test_an_option_changes_its_stage_and_what_follows(survey, override, stages):
    assert changed(names(survey), names(survey, {**PAPER, **override})) == stages


def literally(graph, config) -> dict[str, dict[str, str]]:
    """Name every node as the page says, one by one."""
    tile, names = graph.tile, {}
    for variant, chain in config.chains.items():
        made = names[variant] = {}
        for stage in STAGES:
            options = chain[stage.name]
            module = stage_module(options)
            made_of = [
                stage.name,
                module.VERSION,
                options.model_dump(mode="json"),
                [made[name] for name in stage.inputs] or asdict(tile.grid),
                [source for source in graph.sources if source[0] in getattr(module, "READS", ())],
                [],
            ]
            text = json.dumps(made_of, sort_keys=True, separators=(",", ":"))
            made[stage.name] = hashlib.sha256(text.encode()).hexdigest()[:32]
    return names


@pytest.mark.parametrize("name", ["paper", "ablation"])
def test_names_are_the_hash_of_what_makes_a_node(name, survey):
    config = load_config(name)
    pattern = Pattern.of(config)
    for tile in Catalog.read(survey).tiles:
        graph = pattern.graph(tile)
        assert graph.variants == literally(graph, config)


def test_an_option_at_its_default_changes_nothing(survey):
    assert names(survey) == names(survey, {**PAPER, "fit": {"method": "nurbs", "degree": 3}})


def test_a_version_changes_its_stage_and_what_follows(survey, monkeypatch):
    before = names(survey)
    monkeypatch.setattr(ecsrc, "VERSION", ecsrc.VERSION + 1)
    assert changed(before, names(survey)) == ["ecsrc", "fit", "sample", "evaluate", "assess"]


def test_stage_under_another_module_name_keeps_its_fingerprint(survey, monkeypatch):
    before = tile_graph(Catalog.read(survey).tiles[0], compose(PAPER, "x"))
    monkeypatch.setitem(sys.modules, "elsewhere", ecsrc)
    monkeypatch.setattr(ecsrc, "__name__", "elsewhere")
    monkeypatch.setattr(ecsrc.Options, "__module__", "elsewhere")
    after = tile_graph(Catalog.read(survey).tiles[0], compose(PAPER, "x"))
    moved = after.nodes[after.variants["flexroad"]["ecsrc"]]
    assert stage_module(moved.options).__name__ == "elsewhere"
    assert after == before
    assert dict(map(versions_of, after.nodes.values())) == dict(map(versions_of, before.nodes.values()))


def versions_of(node) -> tuple[str, int]:
    return stage_version(node.stage, node.options)


def test_variants_share_what_they_have_in_common(survey):
    graph = tile_graph(Catalog.read(survey).tiles[0], compose(PAPER, "x"))
    assert len(graph.nodes) == 3 + 3 * 4
    stages = [node.stage for node in graph.nodes.values()]
    assert sorted(set(stages), key=stages.index) == list(STAGE_NAMES)
    for node in graph.nodes.values():
        assert all(i in graph.nodes for i in node.inputs)
    assert [node.stage for node in graph.nodes.values() if not node.stored].count("load") == 1


def test_tiles_and_moved_surveys(survey, tmp_path):
    tiles = Catalog.read(survey).tiles
    config = compose(PAPER, "x")
    assert tile_graph(tiles[0], config).fingerprint != tile_graph(tiles[1], config).fingerprint
    before = names(survey)
    # copytree keeps times; relative names do the rest.
    moved = shutil.copytree(survey.parent, tmp_path / "moved") / survey.name
    assert names(moved) == before


def test_sources_count_by_size_and_time_or_by_bytes(survey):
    tile = Catalog.read(survey).tiles[0]
    path = tile.paths(tile.layers[0])[0]
    plain, summed = names(survey), names(survey, checksum=True)
    assert changed(plain, summed) == list(STAGE_NAMES)
    os.utime(path, (1, 1))
    assert changed(plain, names(survey)) == list(STAGE_NAMES)
    assert names(survey, checksum=True) == summed
    path.write_bytes(path.read_bytes() + b"\0")
    assert changed(summed, names(survey, checksum=True)) == list(STAGE_NAMES)
    path.unlink()
    missing = names(survey)
    assert changed(plain, missing) == list(STAGE_NAMES)


def test_a_layer_changes_the_stages_that_read_it(survey, tmp_path, monkeypatch):
    (tile, *_) = Catalog.read(survey).tiles
    photo = tmp_path / "dop.tif"
    photo.write_bytes(b"old")
    tile = replace(tile, layers=(*tile.layers, Layer("dop", (str(photo),))))

    def made():
        return tile_graph(tile, compose(PAPER, "x")).variants["flexroad"]

    unread = made()
    photo.write_bytes(b"newer")
    assert made() == unread
    monkeypatch.setattr(mask, "READS", ("dop",), raising=False)
    read = made()
    assert changed(unread, read) == list(STAGE_NAMES[1:])
    photo.write_bytes(b"newest of all")
    assert changed(read, made()) == list(STAGE_NAMES[1:])


def test_files_that_options_name_count_by_their_bytes(survey, tmp_path, monkeypatch):
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
