"""Configurations in YAML."""

import shutil
from pathlib import Path

from flexroad.pipeline.config.loading import load_config, shipped

CHILD = """extends: paper
fit:
  control_points: [12, 12]
  iterations: 30
  learning_rate: 5.0e-2
load: &load {halo_m: 20, min_valid: 0.5}
variants:
  plane: {fit: plane, sample: corners}
  flexroad: {load: *load}
export:
  variants: [flexroad]
"""


def make(folder: Path) -> list[Path]:
    (folder / "child.yaml").write_text(CHILD)
    shipped_ones = (shutil.copy(path, folder) for path in shipped().values())
    return [folder / "child.yaml", *map(Path, shipped_ones)]


def read(path: Path) -> None:
    load_config(path)
