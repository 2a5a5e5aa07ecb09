"""Models of the segmentation: trees of `pixels`, heads of `dinov2`."""

from pathlib import Path

import numpy as np

from flexroad.tasks.segment.dinov2.head import read_head
from flexroad.tasks.segment.pixels.model import encode
from tests.tasks.segment.dinov2.test_head import head
from tests.tasks.segment.pixels.test_trees import ABOUT, damaged_nodes, fitted, predicted


def make(folder: Path) -> list[Path]:
    whole = encode(ABOUT, fitted(4))
    made = {"model.skops": whole, "head.safetensors": head()}
    # Valid archives, as random bytes hardly ever give one.
    made |= {f"nodes-{number}.skops": data for number, data in enumerate(damaged_nodes(whole, 20))}
    for name, data in made.items():
        (folder / name).write_bytes(data)
    return [folder / name for name in made]


def read(path: Path) -> None:
    if path.suffix == ".skops":
        assert np.isfinite(predicted(path)).all()
    else:
        read_head(path)
