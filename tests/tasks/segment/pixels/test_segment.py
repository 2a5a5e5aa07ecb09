"""`pixels` from synthetic tiles with an orthophoto to a mask, end to end."""

import importlib.util
import io
from dataclasses import replace

import numpy as np
import pytest
import rasterio
from rasterio.transform import from_origin
from skops.io import dumps

from flexroad.tasks import TaskError
from flexroad.tasks.roads.mask_cleanup import NOTHING
from flexroad.tasks.segment.pixels import train as training
from flexroad.tasks.segment.pixels.model import read_model, require
from flexroad.tasks.segment.pixels.segment import Options, files, segment
from flexroad.tasks.segment.pixels.train import even_threshold
from flexroad.tasks.segment.pixels.trees import read_archive
from flexroad.tasks.segment.training_types import Sample
from flexroad.tasks.synthetic import block, make_scene
from flexroad.tasks.synthetic.orthophoto import orthophoto
from flexroad.tasks.types import Source, TileData

SEED, SIZE_M = 3, 120
QUICK = training.Options(cells=2000, rounds=25, learning_rate=0.2, leaf_cells=30, folds=2)


@pytest.fixture(scope="module")
def samples(tmp_path_factory):
    """Six tiles of a synthetic suburb, each with its own photo."""
    folder = tmp_path_factory.mktemp("town")
    return [make_sample(name, grid, folder / f"{name}.tif") for name, grid in block(6, SIZE_M)]


def make_sample(name, grid, path) -> Sample:
    scene = make_scene(grid, SEED, "suburban")
    colour = orthophoto(grid, SEED, "suburban")
    profile = {"driver": "GTiff", "count": 3, "dtype": "uint8", "crs": grid.crs}
    profile |= {"height": colour.shape[1], "width": colour.shape[2]}
    profile["transform"] = from_origin(grid.west, grid.north, 0.5, 0.5)
    with rasterio.open(path, "w", **profile) as file:
        file.write(colour)
    data = TileData(name, grid, grid, scene.dsm, scene.dtm, dop=Source("dop", (path,)))
    return Sample(data, scene.reference_road, np.isfinite(scene.dsm))


@pytest.fixture(scope="module")
def trained(samples):
    return training.train(samples[:4], samples[4:5], QUICK)


@pytest.fixture(scope="module")
def model(trained, tmp_path_factory):
    return written(trained, tmp_path_factory.mktemp("model"))


def written(trained, folder):
    path = folder / f"model{trained.suffix}"
    path.write_bytes(trained.model)
    return path


def iou(mask, road):
    return (mask & road).sum() / (mask | road).sum()


def fails(match, data, **options):
    with pytest.raises(TaskError, match=match) as caught:
        segment(data, Options(**options))
    assert "\n" not in str(caught.value)
    return caught.value


def without_photo(sample):
    return replace(sample, data=replace(sample.data, dop=None))


def test_segment_unseen_tile_gives_most_roads(samples, model, trained):
    result = segment(samples[5].data, Options(model=model, cleanup=NOTHING))
    road = samples[5].road
    threshold = read_model(model).about.threshold
    np.testing.assert_array_equal(result.mask, result.probability >= threshold)
    assert result.probability.dtype == np.float32
    assert result.probability.min() >= 0
    assert result.probability.max() <= 1
    low = samples[5].data.dsm - samples[5].data.dtm < 0.3
    assert iou(result.mask, road) > 0.75 > iou(low, road)
    assert trained.history[-1].train_loss < trained.history[0].train_loss
    assert trained.history[-1].validation_loss < trained.history[0].validation_loss


@pytest.mark.slow
def test_segment_heights_only_ignores_photo(samples, tmp_path, model):
    bare = [without_photo(sample) for sample in samples]
    path = written(training.train(bare[:4], bare[4:5], QUICK), tmp_path)
    assert not read_model(path).about.photo
    result = segment(bare[5].data, Options(model=path, cleanup=NOTHING))
    # A model trained without photos ignores the photo of a tile.
    np.testing.assert_array_equal(
        result.probability, segment(samples[5].data, Options(model=path, cleanup=NOTHING)).probability
    )
    with_colours = segment(samples[5].data, Options(model=model, cleanup=NOTHING))
    assert 0.2 < iou(result.mask, samples[5].road) < iou(with_colours.mask, samples[5].road)


@pytest.mark.slow
def test_train_is_repeatable_and_ignores_validation_tiles(samples, trained):
    again = training.train(samples[:4], samples[4:5], QUICK)
    assert (content(again), again.history) == (content(trained), trained.history)
    other = training.train(samples[:4], samples[5:6], QUICK)
    assert trees(content(other)) == trees(content(trained))
    assert other.history != trained.history


def content(trained):
    """Metadata and trees of a model; the bytes of its zip also contain the time."""
    about, trees, _ = read_archive(io.BytesIO(trained.model))
    return about, [nodes.tobytes() for nodes in trees]


def trees(content):
    return content[1]


def test_train_single_tile_gives_usable_model(samples, tmp_path):
    path = written(training.train(samples[:1], samples[1:2], QUICK), tmp_path)
    assert iou(segment(samples[5].data, Options(model=path)).mask, samples[5].road) > 0.5


def test_segment_threshold_replaces_that_of_model(samples, model):
    few, many = (
        segment(samples[5].data, Options(model=model, threshold=t, cleanup=NOTHING)).mask for t in (0.9, 0.1)
    )
    assert few.sum() < many.sum()
    assert (many | ~few).all()
    assert files(Options(model=model)) == (model,)


def test_segment_void_beyond_survey_is_no_road(samples, model):
    data = samples[5].data
    dsm, dtm = data.dsm.copy(), data.dtm.copy()
    dsm[:, :40], dtm[:, :40] = np.nan, np.nan
    result = segment(replace(data, dsm=dsm, dtm=dtm), Options(model=model))
    assert not result.mask[:, :40].any()
    assert not result.probability[:, :40].any()
    assert result.outside[:, :40].all()


def test_segment_no_road_gives_empty_mask_and_note(samples, model):
    road = segment(samples[5].data, Options(model=model, threshold=0.9999))
    assert not road.mask.any()
    assert "no road on this tile: probabilities reach" in road.notes[-1]


def test_segment_and_train_unusable_tile_raises(samples, model):
    error = fails("no orthophoto .* was trained with colours", without_photo(samples[5]).data, model=model)
    assert error.layer == "dop"
    with pytest.raises(TaskError, match="has no orthophoto"):
        training.train([samples[0], without_photo(samples[1])], samples[2:3], QUICK)
    with pytest.raises(TaskError, match="no labels of both road and other ground"):
        training.train([replace(samples[0], road=samples[0].labelled)], samples[2:3], QUICK)


def test_segment_broken_model_names_file_and_remedy(samples, model, tmp_path):
    data, path = samples[5].data, tmp_path / "model.skops"
    assert fails("no model for segment: pixels at .*: `flexroad train", data, model=path).file == str(path)
    whole = model.read_bytes()
    middle = len(whole) // 2
    for content in (
        b"",
        b"not a zip",
        whole[:middle],
        whole[:middle] + bytes(64) + whole[middle + 64 :],
        dumps({"about": "{}", "classifier": None}),
        dumps({"something": "else"}),
        dumps({"about": read_model(model).about.model_dump_json(), "classifier": np.zeros(3)}),
    ):
        path.write_bytes(content)
        assert fails(
            "is not a model for segment: pixels, or is damaged .*`flexroad train", data, model=path
        ).file == str(path)


def test_segment_model_with_code_raises(samples, tmp_path):
    path = tmp_path / "model.skops"
    path.write_bytes(dumps({"about": "{}", "classifier": tmp_path.joinpath}))
    fails("is not a model for segment: pixels, or is damaged", samples[5].data, model=path)


def test_segment_other_cell_size_adds_note(samples, model):
    data = samples[5].data
    coarse = replace(data.grid, cell=2.0, width=60, height=60)
    half = replace(data, grid=coarse, core=coarse, dsm=data.dsm[::2, ::2], dtm=data.dtm[::2, ::2])
    notes = segment(half, Options(model=model, threshold=0.05)).notes
    assert "the model was trained on cells of 1 m, not 2 m" in notes[0]


def test_even_threshold_predicts_true_area():
    rng = np.random.default_rng(1)
    for _ in range(20):
        road = rng.random(500) < 0.3
        probability = np.clip(rng.normal(0.3 + 0.2 * road, 0.2), 0.02, 0.98)
        weight = rng.choice([1.0, 3.0], 500)
        threshold, iou = even_threshold(probability, road, weight)
        predicted = probability >= threshold
        assert abs(weight[predicted].sum() - weight[road].sum()) <= 3
        assert iou == pytest.approx(weight[predicted & road].sum() / weight[predicted | road].sum())


def test_even_threshold_does_not_split_equal_probabilities():
    probability = np.array([0.8, 0.6, 0.6, 0.6, 0.2])
    road = np.array([True, True, False, False, False])
    threshold, iou = even_threshold(probability, road, np.ones(5))
    assert threshold == pytest.approx(0.4)
    assert iou == pytest.approx(2 / 4)


@pytest.mark.parametrize("module", ["sklearn", "skops"])
def test_require_missing_package_names_extra(monkeypatch, module):
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == module else find(name))
    with pytest.raises(TaskError, match=r"pip install 'flexroad\[train\]'"):
        require()
