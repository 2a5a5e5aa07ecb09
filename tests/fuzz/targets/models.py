"""Models of the segmentation: heads of `dinov2`."""

from pathlib import Path

from flexroad.tasks.segment.dinov2.head import read_head
from tests.tasks.segment.dinov2.test_head import head


def make(folder: Path) -> list[Path]:
    path = folder / "head.safetensors"
    path.write_bytes(head())
    return [path]


def read(path: Path) -> None:
    read_head(path)
