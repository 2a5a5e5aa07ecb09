"""Heads from others: refused if a head cannot have their sizes or values."""

import json
import os
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import save

from flexroad.tasks import TaskError
from flexroad.tasks.segment.dinov2.head import KEY, About, Head, read_head
from tests import fuzz

ABOUT = {
    "backbone": "facebook/dinov2-small",
    "model_type": "dinov2",
    "registers": 0,
    "weights": "0123456789abcdef",
    "hidden_size": 8,
    "layers": 2,
    "window_px": 28,
    "gsd_m": 0.2,
    "mean": (0.5, 0.5, 0.5),
    "std": (0.2, 0.2, 0.2),
    "classes": ("road",),
    "threshold": 0.5,
    "trained": {},
}
WEIGHT, BIAS = np.ones((1, 16), np.float32), np.zeros(1, np.float32)


def head(weight=WEIGHT, bias=BIAS, **about) -> bytes:
    return save({"weight": weight, "bias": bias}, {KEY: json.dumps(ABOUT | about)})


def fails(path: Path, match: str) -> None:
    with pytest.raises(TaskError, match=match) as caught:
        read_head(path)
    assert str(path) in str(caught.value)
    assert "`flexroad train" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_read_head_is_that_written(tmp_path):
    path = tmp_path / "head.safetensors"
    path.write_bytes(Head(WEIGHT, BIAS, About(**ABOUT)).encode())
    assert read_head(path).about == About(**ABOUT)
    np.testing.assert_array_equal(read_head(path).weight, WEIGHT)


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (head(weight=np.ones((1, 15), np.float32)), r"its weight is F32 of shape \(1, 15\)"),
        (head(weight=np.ones((1, 16), np.float64)), "its weight is F64"),
        (head(weight=np.full((1, 16), np.nan, np.float32)), "its weight has values that are not numbers"),
        (head(bias=np.zeros(0, np.float32)), r"its bias is F32 of shape \(0,\), not F32 of \(1,\)"),
        (head(bias=np.full(1, np.inf, np.float32)), "its bias has values that are not numbers"),
        (head(classes=("lake",)), "road is not one of its classes"),
        (head(std=(0.2, 0, 0.2)), "std.1: .*greater than 0"),
        (head(mean=(1e300, 0, 0)), "mean.0"),
        (head(layers=10**9), "layers"),
        (head(window_px=14 * 10**8), "window_px"),
        (head(gsd_m=1e-9), "gsd_m"),
        (head(kind="pickle"), "kind"),
        (head()[:-1], "damaged"),
        (b"\xff" * 8 + head()[8:], "damaged"),
        (save({"bias": BIAS}, {KEY: json.dumps(ABOUT)}), "damaged"),
    ],
)
def test_read_damaged_head_raises(tmp_path, content, reason):
    path = tmp_path / "head.safetensors"
    path.write_bytes(content)
    fails(path, reason)


def test_read_large_file_or_pipe_raises_at_once(tmp_path):
    path = tmp_path / "head.safetensors"
    path.write_bytes(head())
    os.truncate(path, 2**40)
    fails(path, "more than 256 MiB")
    path.unlink()
    os.mkfifo(path)
    fails(path, "no head for DINOv2")


@pytest.mark.slow
def test_read_damaged_at_random_raises_or_reads(tmp_path):
    path = tmp_path / "head.safetensors"
    path.write_bytes(head())
    fuzz.check("flexroad.tasks.segment.dinov2.head", "read_head", fuzz.damaged(head(), 200, 1), path)
