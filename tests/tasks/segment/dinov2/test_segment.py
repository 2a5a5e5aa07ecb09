"""DINOv2 with random weights: it runs the same code as the real model, but cannot recognise roads."""

import json
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import safetensors.numpy

from flexroad.catalog import Catalog, Grid
from flexroad.catalog.lazy import lazy
from flexroad.tasks import TaskError, load
from flexroad.tasks.io.orthophoto import read_photo
from flexroad.tasks.roads import coregistration
from flexroad.tasks.segment.dinov2 import backbone, head
from flexroad.tasks.segment.dinov2.backbone import load_backbone, normalised
from flexroad.tasks.segment.dinov2.head import Head, check, predictor, read_head
from flexroad.tasks.segment.dinov2.segment import Options, files, segment
from flexroad.tasks.types import TileData
from flexroad.tools.train import fit_head as training
from flexroad.tools.train.fit_head import THRESHOLDS, Sample, Windows, at_cells, best_threshold
from tests.gpu import needs_gpu
from tests.make_backbone import save_backbone

WINDOW, GSD = 112, 0.1


@pytest.fixture(scope="session")
def backbones(tmp_path_factory) -> dict[int, Path]:
    """Folders of backbones by number of registers."""
    folder = tmp_path_factory.mktemp("backbones")
    return {n: save_backbone(folder / f"tiny-{n}", registers=n, hidden_size=96) for n in (0, 4)}


@pytest.fixture(scope="session")
def sample(tmp_path_factory) -> Sample:
    """A synthetic tile of 60 m with an orthophoto; a fifth of it is road."""
    from flexroad.tools.synthetic.scenes import write_scenes

    catalog = Catalog.read(write_scenes(tmp_path_factory.mktemp("scene"), 2, seed=3, size_m=60, dop=True))
    data = load.load(catalog.tiles[1], load.Options())
    return Sample(data, data.reference_road, np.isfinite(data.dsm))


def train_options(folder: Path, **options) -> training.Options:
    defaults = {"layers": 3, "gsd_m": GSD, "window_px": WINDOW, "epochs": 60, "learning_rate": 0.03}
    return training.Options(backbone=str(folder), **(defaults | {"weight_decay": 0} | options))


@pytest.fixture(scope="session")
def model(backbones, sample, tmp_path_factory) -> Path:
    """A head trained on the sample tile."""
    path = tmp_path_factory.mktemp("heads") / "head.safetensors"
    path.write_bytes(training.train([sample], [sample], train_options(backbones[0]), print)[0])
    return path


def segmented(data: TileData, model: Path, **options):
    return segment(data, Options(model=model, **({"cleanup": "none"} | options)))


def with_threshold(path: Path, threshold: float) -> Path:
    """Write the same head with another threshold."""
    head = read_head(path)
    other = path.with_name(f"{threshold}.safetensors")
    about = head.about.model_copy(update={"threshold": threshold})
    other.write_bytes(Head(head.weight, head.bias, about).encode())
    return other


def iou(a, b) -> float:
    return np.count_nonzero(a & b) / np.count_nonzero(a | b)


@pytest.mark.parametrize("registers", [0, 4])
def test_tokens_belong_to_patches(backbones, registers):
    import torch

    backbone = load_backbone(str(backbones[registers]), "cpu")
    assert (backbone.registers, backbone.layers, backbone.hidden_size) == (registers, 3, 96)
    windows = np.random.default_rng(0).normal(size=(2, 3, 42, 42)).astype(np.float32)
    tokens = backbone.tokens(windows, 2)
    assert tokens.shape == (2, 3, 3, 2 * 96)
    # The model normalises its last layer itself; the class token is first, then come the registers.
    last = backbone.model(torch.from_numpy(windows)).last_hidden_state
    torch.testing.assert_close(tokens[..., 96:].flatten(1, 2), last[:, -9:])
    # A change in one patch changes the token of that patch most.
    windows[:, :, 14:28, 28:42] = 0
    change = (backbone.tokens(windows, 2) - tokens).abs().sum(-1)[0]
    assert int(change.argmax()) == 3 * 1 + 2


def test_half_precision_changes_result_slightly(backbones, model, sample):
    whole, half = (segmented(sample.data, model, device="cpu", half=half) for half in (False, True))
    difference = np.abs(whole.probability - half.probability)
    assert 0 < difference.max() < 0.2
    assert difference.mean() < 0.01
    assert iou(whole.mask, half.mask) > 0.97


def test_train_small_scene_reproduces_labels(model, sample):
    road = segmented(sample.data, model)
    assert iou(road.mask, sample.road) > 0.75
    # A mask that is road everywhere has this fraction as IoU.
    assert sample.road.mean() < 0.25
    inside, beyond = (road.probability[cells].mean() for cells in (sample.road, ~sample.road))
    assert inside > 0.8
    assert beyond < 0.1
    assert road.probability.dtype == np.float32


def test_train_again_with_other_labels_in_unlabelled_cells_gives_equal_models(backbones, sample, tmp_path):
    lines = []
    labelled = np.zeros_like(sample.labelled)
    labelled[:, 20:] = True
    right, wrong = (
        replace(sample, labelled=labelled, road=road) for road in (sample.road, sample.road ^ ~labelled)
    )
    options = train_options(backbones[0], epochs=5)
    first, history = training.train([right], [right], options, lines.append)
    assert first == training.train([wrong], [wrong], options, print)[0]
    assert lines == [
        f"epoch {n} of 5: loss {loss:.4f}, validation {validation:.4f}"
        for n, (loss, validation) in enumerate(history, 1)
    ]
    assert history[-1][1] < history[0][1]
    path = tmp_path / "head.safetensors"
    path.write_bytes(first)
    about = read_head(path).about
    assert (about.gsd_m, about.window_px, about.layers, about.classes) == (GSD, WINDOW, 3, ("road",))
    assert about.trained["train_cells"] == labelled.sum()
    assert about.trained["train_road_cells"] == (sample.road & labelled).sum()
    assert about.trained["train_tiles"] == sample.data.tile_id


def test_train_stops_early_and_keeps_best_epoch_and_needs_labels(backbones, sample):
    """The labels of the validation tile are the inverse of the training labels."""
    inverse = replace(sample, road=~sample.road)
    full, history = training.train([sample], [inverse], train_options(backbones[0], patience=3), print)
    best = 1 + int(np.argmin([validation for _, validation in history]))
    assert len(history) == best + 3 < 60
    until, _ = training.train([sample], [inverse], train_options(backbones[0], epochs=best), print)
    np.testing.assert_array_equal(*(safetensors.numpy.load(one)["weight"] for one in (full, until)))
    no_road = replace(sample, road=np.zeros_like(sample.road))
    with pytest.raises(TaskError, match="no training tile has an orthophoto and labels of both road"):
        training.train([no_road], [sample], train_options(backbones[0]), print)
    no_photo = replace(sample, data=replace(sample.data, dop=None))
    with pytest.raises(TaskError, match="no validation tile has an orthophoto"):
        training.train([sample], [no_photo], train_options(backbones[0]), print)


def test_at_cells_interpolates_like_predictor(backbones, model):
    """The loss uses the same logit at a pixel's centre as the prediction."""
    import torch

    backbone, head = load_backbone(str(backbones[0]), "cpu"), read_head(model)
    windows = np.random.default_rng(1).normal(size=(1, 3, 56, 56)).astype(np.float32)
    predicted = predictor(head, backbone)(windows)[0]
    centres = 2 * (np.arange(56, dtype=np.float32) + 0.5) / 56 - 1
    position = np.stack(np.meshgrid(centres, centres), axis=-1).reshape(-1, 2)
    labels = position, np.zeros(len(position), np.float32)
    tokens = backbone.tokens(windows, 3).numpy()
    line = torch.from_numpy(head.weight[0]), torch.tensor(float(head.bias[0]))
    logits, _ = at_cells(Windows(tokens, [labels], []), np.array([0]), *line)
    np.testing.assert_allclose(logits.sigmoid().numpy().reshape(56, 56), predicted, atol=1e-4)


def test_best_threshold_maximises_iou():
    import torch

    rng = np.random.default_rng(2)
    tokens = rng.normal(size=(1, 8, 8, 2)).astype(np.float16)
    centres = 2 * (np.arange(8, dtype=np.float32) + 0.5) / 8 - 1
    position = np.stack(np.meshgrid(centres, centres), axis=-1).reshape(-1, 2)
    weight, bias = np.array([1.5, -1], np.float32), 0.3
    level = 1 / (1 + np.exp(-(tokens[0].astype(float) @ weight + bias))).ravel()
    road = level + rng.normal(0, 0.2, 64) > 0.7
    windows = Windows(tokens, [(position, road.astype(np.float32))], [])
    each = [iou(level >= threshold, road) for threshold in THRESHOLDS]
    threshold, best = best_threshold(windows, torch.from_numpy(weight), torch.tensor(bias))
    assert threshold == THRESHOLDS[np.argmax(each)]
    assert best == pytest.approx(max(each))


def test_segment_does_not_depend_on_tiling(model, sample):
    data, grid = sample.data, sample.data.grid
    smaller = Grid(grid.crs, grid.west + 20, grid.north - 17, 1.0, 35, 31)
    window = grid.window(smaller)
    part = replace(data, grid=smaller, core=smaller, dsm=data.dsm[window], dtm=data.dtm[window])
    whole, piece = segmented(data, model), segmented(part, model)
    np.testing.assert_allclose(piece.probability, whole.probability[window], atol=2e-5)
    assert np.mean(piece.mask == whole.mask[window]) > 0.999


def test_segment_threshold_changes_mask_only(model, sample):
    strict, lax = (segmented(sample.data, with_threshold(model, t)) for t in (0.9, 0.1))
    np.testing.assert_array_equal(strict.probability, lax.probability)
    assert not np.any(strict.mask & ~lax.mask)
    assert strict.mask.sum() < lax.mask.sum()
    # A cell's probability is the mean of 10 x 10 pixels; its mask is the central pixel's.
    assert np.mean(lax.mask == (lax.probability >= 0.1)) > 0.9


def test_segment_cells_without_photo_are_no_road(model, sample):
    data, grid = sample.data, sample.data.grid
    wide = grid.buffered(30)
    rows, cols = wide.window(grid)
    around = {name: np.pad(getattr(data, name), 30, mode="edge") for name in ("dsm", "dtm")}
    own = replace(data.dop, paths=data.dop.paths[:1])
    # Pixels without data have the mean colour.
    photo = read_photo(own, grid.buffered(10))
    assert not photo.known.all()
    np.testing.assert_array_equal(normalised(photo)[:, ~photo.known], 0)
    road = segmented(replace(data, grid=wide, core=grid, dop=own, **around), with_threshold(model, 0.01))
    beyond = np.ones(wide.shape, bool)
    beyond[rows, cols] = False
    assert not road.mask[beyond].any()
    assert road.mask[rows, cols].any()
    assert road.notes[0] == f"dop: {beyond.mean():.1%} of the cells have no orthophoto and count as no road"


def test_segment_shifted_photo_adds_note(model, sample, monkeypatch):
    """Its measurement is tested in tests/tasks/roads/test_coregistration.py; this tile is too small."""
    assert segmented(sample.data, model).notes == ()
    monkeypatch.setattr(coregistration, "note", lambda data, photo: f"{data.tile_id}: {photo.grid.cell:g} m")
    (note,) = segmented(sample.data, model).notes
    assert note == f"{sample.data.tile_id}: {read_head(model).about.gsd_m:g} m"


def test_segment_no_road_gives_empty_mask_and_note(model, sample):
    head = read_head(model)
    blind = model.with_name("blind.safetensors")
    blind.write_bytes(Head(head.weight * 0, head.bias * 0 - 1, head.about).encode())
    road = segmented(sample.data, blind)
    assert not road.mask.any()
    assert "no road on this tile: probabilities reach 0.27, the threshold" in road.notes[-1]


def test_segment_broken_head_names_file_and_remedy(backbones, model, sample, tmp_path):
    with pytest.raises(TaskError, match="no orthophoto .* give --dop to") as caught:
        segmented(replace(sample.data, dop=None), model)
    assert caught.value.layer == "dop"
    broken = tmp_path / "broken.safetensors"
    broken.write_bytes(model.read_bytes()[:-100])
    text = tmp_path / "text.safetensors"
    text.write_text("<html>404 Not Found</html>")
    no_head = tmp_path / "other.safetensors"
    safetensors.numpy.save_file({"weight": np.zeros((1, 4), np.float32)}, no_head, {"format": "pt"})
    weights = next(backbones[0].glob("*.safetensors"))
    for path in (tmp_path / "none.safetensors", tmp_path, broken, text, no_head, weights):
        with pytest.raises(TaskError, match=f"{path}.*flexroad train CATALOG --labels") as caught:
            segmented(sample.data, path)
        assert "\n" not in str(caught.value)
        assert caught.value.file == str(path)


def test_segment_other_backbone_raises(backbones, model, sample, tmp_path):
    other = save_backbone(tmp_path / "other", seed=1, hidden_size=96)
    with pytest.raises(TaskError, match=r"head was trained on .*tiny-0, not on .*other \(weights"):
        segmented(sample.data, model, backbone=str(other))
    with pytest.raises(TaskError, match="model_type dinov2 not dinov2_with_registers, registers 0 not 4"):
        segmented(sample.data, model, backbone=str(backbones[4]))
    head = read_head(model)
    deeper = Head(head.weight, head.bias, head.about.model_copy(update={"layers": 4}))
    with pytest.raises(TaskError, match="uses 4 layers, the backbone has 3"):
        check(deeper, load_backbone(str(backbones[0])))


def test_segment_moved_or_downloaded_backbone_gives_same_result(
    backbones, model, sample, tmp_path, monkeypatch
):
    """The cache of downloads has the folder layout of `hf download`."""
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(tmp_path))
    commit = "0123456789abcdef0123456789abcdef01234567"
    home = tmp_path / "models--facebook--dinov2-tiny"
    snapshot = shutil.copytree(backbones[0], home / "snapshots" / commit)
    (home / "refs").mkdir()
    (home / "refs" / "main").write_text(commit)
    expected = segmented(sample.data, model).probability
    for name in ("facebook/dinov2-tiny", str(snapshot)):
        found = segmented(sample.data, model, backbone=name).probability
        np.testing.assert_array_equal(found, expected)
    moved = Options(model=model, backbone=str(snapshot))
    assert files(moved) == (model, snapshot / "config.json", snapshot / "model.safetensors")
    assert files(Options(model=model, backbone="facebook/dinov2-small")) == (model,)


def test_load_backbone_missing_weights_names_remedy(backbones, tmp_path, monkeypatch):
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(tmp_path / "cache"))
    with pytest.raises(TaskError, match="facebook/dinov2-tiny are not .* `hf download facebook/dinov2-tiny`"):
        load_backbone("facebook/dinov2-tiny")
    with pytest.raises(TaskError, match="no folder /no/where"):
        load_backbone("/no/where")
    with pytest.raises(TaskError, match="no readable config.json .* `hf download facebook/dinov2-small`"):
        load_backbone(str(tmp_path))
    (tmp_path / "config.json").write_text(json.dumps({"model_type": "vit"}))
    with pytest.raises(TaskError, match="model of type 'vit'"):
        load_backbone(str(tmp_path))
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    with pytest.raises(TaskError, match="no device 'cuda'"):
        load_backbone(str(backbones[0]), "cuda")


def test_load_backbone_damaged_weights_raises_one_line(backbones, tmp_path):
    (tmp_path / "config.json").write_bytes((backbones[0] / "config.json").read_bytes())
    weights = tmp_path / "model.safetensors"
    content = (backbones[0] / weights.name).read_bytes()
    arrays = safetensors.numpy.load(content)
    arrays.pop("layernorm.weight")
    for damaged, message in (
        (b"", "cannot read the weights"),
        (content[:100], "cannot read the weights"),
        (content[:100_000], "cannot read the weights"),
        (safetensors.numpy.save(arrays, {"format": "pt"}), "weights lack 1 arrays"),
    ):
        weights.write_bytes(damaged)
        with pytest.raises(TaskError, match=message) as caught:
            load_backbone(str(tmp_path))
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize("module", ["transformers", "safetensors"])
def test_segment_without_extra_names_package(model, sample, monkeypatch, module):
    load_backbone.cache_clear()
    for name in [name for name in sys.modules if name.split(".")[0] == module]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setattr({"transformers": backbone, "safetensors": head}[module], module, lazy(module))
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(TaskError, match=rf'needs {module}: pip install "flexroad\[dinov2\]"'):
        segmented(sample.data, model)


def test_tokens_full_gpu_raises(backbones, monkeypatch):
    import torch

    def full(**_):
        raise torch.OutOfMemoryError("CUDA out of memory.")

    backbone = load_backbone(str(backbones[0]), "cpu")
    monkeypatch.setattr(backbone.model, "forward", full)
    with pytest.raises(TaskError, match="too little memory; use a smaller batch or fewer workers"):
        backbone.tokens(np.zeros((1, 3, 28, 28), np.float32), 1)


@pytest.mark.parametrize("registers", [0, 4])
def test_tokens_on_gpu_equal_those_of_the_cpu(backbones, registers):
    needs_gpu()
    windows = np.random.default_rng(0).normal(size=(2, 3, WINDOW, WINDOW)).astype(np.float32)
    gpu, half, cpu = (
        load_backbone(str(backbones[registers]), *how) for how in (("auto",), ("cuda", True), ("cpu",))
    )
    assert (gpu.device, half.device) == ("cuda", "cuda")
    expected = cpu.tokens(windows, 2)
    spread = expected.std()
    assert (gpu.tokens(windows, 2).cpu() - expected).abs().max() < 1e-2 * spread
    error = (half.tokens(windows, 2).cpu() - expected).abs()
    assert 0 < error.mean() < 1e-2 * spread


def test_import_method_imports_no_heavy_package():
    heavy = ["torch", "transformers", "safetensors", "huggingface_hub"]
    code = "import sys, flexroad.tasks.segment.dinov2.segment, flexroad.tools.train.fit_head;"
    code += f"print([m for m in {heavy} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
