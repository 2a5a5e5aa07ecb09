"""Draw docs/images/benchmark_mask.webp: masks of an urban and of a rural tile of the benchmark.

``PYTHONPATH=. python experiments/mask_picture.py docs/images/benchmark_mask.webp``.
"""

import sys
from pathlib import Path

import numpy as np
from PIL import Image

from flexroad.tasks.synthetic import gerod, make_scene
from flexroad.tasks.synthetic.orthophoto import orthophoto

SEED, TILES, SHOWN = 1, 12, ("506000_5600000", "503000_5606000")
GSD, GAP = 0.5, 8
"""Pixel size (m) and width of the white gap between the tiles (pixels)."""
HIGH_M = 2.5
TRUE, FALSE, FALSE_HIGH, MISSED = (60, 120, 255), (255, 210, 0), (255, 30, 30), (255, 255, 255)


def picture(grid, stratum, options) -> np.ndarray:
    """Return the photo with road blue, false road yellow, or red where it is high, and missed road white."""
    scene = make_scene(grid, SEED, stratum, options)
    photo = orthophoto(grid, SEED, stratum, options, GSD).transpose(1, 2, 0).astype(float)
    mask, road, high = scene.road_mask, scene.reference_road, scene.dsm - scene.reference > HIGH_M
    for cells, colour in (
        (mask & road, TRUE),
        (mask & ~road & ~high, FALSE),
        (mask & ~road & high, FALSE_HIGH),
        (~mask & road, MISSED),
    ):
        pixels = np.kron(cells, np.ones((2, 2), bool))
        photo[pixels] = 0.5 * photo[pixels] + 0.5 * np.array(colour)
    return photo


def main() -> None:
    tiles = [picture(*place) for name, *place in gerod.survey(TILES, SEED) if name in SHOWN]
    gap = np.full((tiles[0].shape[0], GAP, 3), 255.0)
    image = Image.fromarray(np.concatenate([tiles[0], gap, *tiles[1:]], axis=1).round().astype(np.uint8))
    image.save(Path(sys.argv[1]), quality=80, method=6)


if __name__ == "__main__":
    main()
