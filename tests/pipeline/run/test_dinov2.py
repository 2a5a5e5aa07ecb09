"""`segment: {method: dinov2}` in a run: selected by the configuration; a tile without a photo fails alone."""

import json
from dataclasses import replace

import numpy as np
import pytest
import yaml

from flexroad.catalog import Catalog
from flexroad.pipeline.config.loading import load_config
from flexroad.pipeline.execute import SerialExecutor
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.run.runner import run_tiles
from flexroad.pipeline.store.tables import read_metrics
from flexroad.tasks import load
from flexroad.tasks.segment.dinov2.head import Head, read_head
from flexroad.tools.synthetic.scenes import write_scenes
from flexroad.tools.train import fit_head as training
from flexroad.tools.train.fit_head import Sample
from tests.conftest import QUICK
from tests.make_backbone import save_backbone


@pytest.fixture
def place(tmp_path):
    """A folder with a catalog of two tiles (the first without photo), a backbone and a trained head."""
    write_scenes(tmp_path / "scenes", 2, seed=3, size_m=60, dop=True)
    first, second = Catalog.read(tmp_path / "scenes" / "catalog.parquet").tiles
    first.paths(first.layer("dop"))[0].unlink()
    dop = second.layer("dop").part([0])
    first = replace(
        first, layers=tuple(layer for layer in first.layers if layer.name != "dop"), nearby=(dop,)
    )
    second = replace(second, layers=tuple(dop if x.name == "dop" else x for x in second.layers))
    Catalog((first, second)).write(tmp_path / "scenes" / "catalog.parquet")
    folder = save_backbone(tmp_path / "backbone", registers=2)
    data = load.load(second, load.Options())
    sample = Sample(data, data.reference_road, np.isfinite(data.dsm))
    options = training.Options(
        backbone=str(folder), layers=2, gsd_m=0.25, window_px=112, epochs=30, learning_rate=0.03
    )
    (tmp_path / "head.safetensors").write_bytes(training.train([sample], [sample], options, print)[0])
    return tmp_path


def results_of(place, **segment):
    options = {"method": "dinov2", "model": str(place / "head.safetensors"), **segment}
    config = place / "config.yaml"
    config.write_text(yaml.safe_dump({**QUICK, "segment": options}, sort_keys=False))
    run = Run.create(place / "run", load_config(config), Catalog.read(place / "scenes" / "catalog.parquet"))
    results = []
    run_tiles(run, SerialExecutor(), watch=results.append)
    return {result.tile_id: result for result in results}


def test_run_with_dinov2_fails_only_tile_without_photo(place):
    first, second = results_of(place, backbone=str(place / "backbone")).values()
    assert (first.status, second.status) == ("failed", "done")
    (failure,) = {fault.line for fault in first.failures}
    assert failure.startswith("segment: LayerMissing: no orthophoto (layer dop)")
    rows = read_metrics(place / "run")
    assert (rows[rows.tile_id == second.tile_id].road_fraction > 0).all()
    # A repeated run computes nothing; a head with other weights computes the stage again.
    again = results_of(place, backbone=str(place / "backbone"))[second.tile_id]
    assert "segment" not in again.computed
    head = read_head(place / "head.safetensors")
    other = Head(head.weight, head.bias - 1, head.about)
    (place / "head.safetensors").write_bytes(other.encode())
    changed = results_of(place, backbone=str(place / "backbone"))[second.tile_id]
    assert changed.computed["segment"] == 1


@pytest.mark.slow
def test_run_uses_backbone_named_in_head(place):
    """The backbone need not be given again, and the head's metadata is readable with safetensors alone."""
    from safetensors import safe_open

    with safe_open(place / "head.safetensors", framework="numpy") as file:
        metadata = json.loads(file.metadata()["flexroad"])
    assert metadata["backbone"] == str(place / "backbone")
    assert metadata["registers"] == 2
    assert [result.status for result in results_of(place).values()] == ["failed", "done"]
