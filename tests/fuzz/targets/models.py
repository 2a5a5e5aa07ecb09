"""Models of the segmentation: trees of `pixels`, heads of `dinov2`."""

from pathlib import Path

import numpy as np

from flexroad.tasks.segment.dinov2.head import read_head
from flexroad.tasks.segment.pixels.model import encode
from tests.tasks.segment.dinov2.test_head import head
from tests.tasks.segment.pixels.test_trees import ABOUT, fitted, predicted, with_damaged_nodes


def make(folder: Path) -> list[Path]:
    whole = encode(ABOUT, fitted(4))
    made = {"model.skops": whole, "head.safetensors": head()}
    for name, data in made.items():
        (folder / name).write_bytes(data)
    return [folder / name for name in made]


def change(path: Path, data: bytes, rng: np.random.Generator) -> bytes:
    """Change nodes within a valid archive: random bytes hardly ever leave one."""
    if path.suffix != ".skops" or rng.random() < 0.3:
        return b""
    return with_damaged_nodes(data, rng)


def read(path: Path) -> None:
    if path.suffix == ".skops":
        assert np.isfinite(predicted(path)).all()
    else:
        read_head(path)
