"""configs/ablation.yaml contains Table II, and its variants share equal nodes."""

from collections import Counter

import pytest

from flexroad.catalog import Catalog
from flexroad.pipeline.config.loading import compose, load_config
from flexroad.pipeline.execute import SerialExecutor
from flexroad.pipeline.graph.graph import Pattern
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.run.runner import run_tiles
from flexroad.pipeline.store.tables import read_metrics
from flexroad.tools.synthetic.scenes import write_scenes

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
    # one per surface: independent of the sampling
    "assess": 18,
}


def test_ablation_graph_has_expected_node_counts(survey):
    config = load_config("ablation")
    graph = Pattern.of(config).graph(Catalog.read(survey).tiles[0])
    assert len(config.chains) == VARIANTS
    assert Counter(node.stage for node in graph.nodes.values()) == NODES


def variants(name, tile):
    """Return the nodes of each variant by stage."""
    return Pattern.of(load_config(name)).graph(tile).variants


def test_main_variants_equal_those_of_paper_configuration(survey):
    tile = Catalog.read(survey).tiles[0]
    ours, paper = (variants(name, tile) for name in ("ablation", "paper"))
    for variant in ("plane", "rgt", "flexroad"):
        del ours[variant]["evaluate"], paper[variant]["evaluate"]
        assert ours[variant] == paper[variant]


NURBS = {"fit", "sample", "evaluate", "assess"}


@pytest.mark.parametrize(
    ("name", "expected"),
    [("ablation_true", {"evaluate"}), ("ablation_dsm", {"evaluate"}), ("literal", NURBS)],
)
def test_other_configuration_changes_only_its_stages(survey, name, expected):
    """Another truth changes the evaluation; `literal` the NURBS and what follows."""
    tile = Catalog.read(survey).tiles[0]
    ours, other = (variants(config, tile) for config in ("ablation", name))
    assert ours.keys() == other.keys()
    for variant, nodes in ours.items():
        changed = {stage for stage in nodes if nodes[stage] != other[variant][stage]}
        without_nurbs = name == "literal" and variant in ("plane", "rgt", "wo_nurbs")
        assert changed == (set() if without_nurbs else expected), variant


@pytest.fixture(scope="module")
def one_tile(tmp_path_factory):
    return Catalog.read(write_scenes(tmp_path_factory.mktemp("one"), 1, seed=5, size_m=80))


def brief(name):
    """Return a shipped configuration with few Adam steps, which is enough for counts and shapes."""
    raw = load_config(name).raw
    return compose({**raw, "fit": {**raw["fit"], "iterations": 3}}, name)


def test_shared_nodes_are_computed_once(one_tile, tmp_path):
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
    # Not stored: raster surfaces, because `load` reads the rasters, and meshes that are not exported.
    rasters = 2
    once_more = {"load": 1, "fit": rasters, "sample": VARIANTS - 1, "evaluate": VARIANTS, "export": 1}
    assert again.computed == once_more

    assert run_tiles(run, SerialExecutor()).cached == 1
