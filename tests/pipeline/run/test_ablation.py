"""configs/ablation.yaml is Table II, and its variants share what they have in common."""

from collections import Counter

import pytest

from flexroad.catalog import Catalog
from flexroad.pipeline.config.loading import compose, load_config
from flexroad.pipeline.execute import SerialExecutor
from flexroad.pipeline.graph.graph import tile_graph
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.run.runner import run_tiles
from flexroad.pipeline.store.tables import read_metrics

VARIANTS = 21
NODES = {
    "load": 1,
    "segment": 1,
    # theta_z at its default and at five other values, and no filter
    "ecsrc": 7,
    # the default, no filter, no DTM, five theta_z, three degrees, four grids; plane, RGT, RGT with DTM
    "fit": 18,
    "sample": VARIANTS,
    "evaluate": VARIANTS,
    # as many as there are surfaces: how they are sampled is no matter
    "assess": 18,
}


def test_every_row_of_table_ii_and_table_i(survey):
    config = load_config("ablation")
    graph = tile_graph(Catalog.read(survey).tiles[0], config)
    assert len(config.chains) == VARIANTS
    assert Counter(node.stage for node in graph.nodes.values()) == NODES


def test_flexroad_is_that_of_the_main_comparison(survey):
    tile = Catalog.read(survey).tiles[0]
    ours, paper = (tile_graph(tile, load_config(name)).variants for name in ("ablation", "paper"))
    for variant in ("plane", "rgt", "flexroad"):
        del ours[variant]["evaluate"], paper[variant]["evaluate"]
        assert ours[variant] == paper[variant]


def test_the_true_mask_changes_the_evaluation_alone(survey):
    tile = Catalog.read(survey).tiles[0]
    ours, true = (tile_graph(tile, load_config(name)).variants for name in ("ablation", "ablation_true"))
    assert ours.keys() == true.keys()
    for variant, made in ours.items():
        assert {stage for stage in made if made[stage] != true[variant][stage]} == {"evaluate"}


@pytest.fixture(scope="module")
def one_tile(tmp_path_factory):
    from flexroad.pipeline.benchmark.scenes import write_scenes

    return Catalog.read(write_scenes(tmp_path_factory.mktemp("one"), 1, seed=5, size_m=80))


def brief(name):
    """Return a shipped configuration with few Adam steps: counts and shapes want no accuracy."""
    raw = load_config(name).raw
    return compose({**raw, "fit": {**raw["fit"], "iterations": 3}}, name)


def test_stages_in_common_run_once(one_tile, tmp_path):
    store = tmp_path / "store"
    run = Run.create(tmp_path / "ours", brief("ablation"), one_tile, store)
    results = []
    run_tiles(run, SerialExecutor(), watch=results.append)
    (result,) = results
    assert result.failures == ()
    assert {stage: result.computed[stage] for stage in NODES} == NODES
    assert len(read_metrics(run.path)) == VARIANTS

    true = Run.create(tmp_path / "true", brief("ablation_true"), one_tile, store)
    run_tiles(true, SerialExecutor(), watch=results.append)
    again = results[-1]
    # Rasters are not stored, as `load` reads them anyway, and of meshes only the exported one.
    rasters = 2
    once_more = {"load": 1, "fit": rasters, "sample": VARIANTS - 1, "evaluate": VARIANTS, "export": 1}
    assert again.computed == once_more

    assert run_tiles(run, SerialExecutor()).cached == 1
