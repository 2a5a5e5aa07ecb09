"""Draw docs/images/export_mosaic.png: the mosaic of a run and a map tile of its PMTiles file.

``python experiments/export_mosaic_picture.py FOLDER docs/images/export_mosaic.png``, where FOLDER has the
formats mosaic and pmtiles. The documents show ``flexroad catalog synthetic`` with nine tiles of 200 m,
of which one was not computed.
"""

import io
import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import rasterio
from PIL import Image
from pmtiles.reader import MmapSource, Reader, all_tiles

LIGHT = np.array([-1.0, 1.0, 1.3])
STEEPER = 4
"""Factor of slopes, which are small on roads."""


def shaded(folder: Path) -> tuple[np.ndarray, tuple[float, float]]:
    """Return the mosaic as colours with transparency, and its width and height (m)."""
    with rasterio.open(folder / "normal.tif") as raster:
        normal = raster.read() * raster.scales[0]
        size = raster.bounds.right - raster.bounds.left, raster.bounds.top - raster.bounds.bottom
    with rasterio.open(folder / "height.tif") as raster:
        height = raster.read(1, masked=True)
    with rasterio.open(folder / "road.tif") as raster:
        road = raster.read(1) == 1
    normal[:2] *= STEEPER
    light = np.tensordot(LIGHT / np.linalg.norm(LIGHT), normal / np.sqrt((normal**2).sum(axis=0)), 1)
    share = (height - height.min()) / (height.max() - height.min())
    colour = plt.get_cmap("gist_earth")(0.35 + 0.5 * share)[..., :3]
    colour[road] = 0.3 * colour[road] + 0.7 * np.array([0.32, 0.32, 0.36])
    bright = (0.35 + 0.95 * light.clip(0, 1))[..., None]
    return np.dstack([(colour * bright).clip(0, 1), ~np.ma.getmaskarray(height)]), size


def finest_tile(path: Path) -> tuple[tuple[int, int, int], np.ndarray]:
    """Return the map tile of the finest level with most heights, and its image."""
    with path.open("rb") as file:
        source = MmapSource(file)
        zoom = Reader(source).header()["max_zoom"]
        images = {tile: data for tile, data in all_tiles(source) if tile[0] == zoom}
    tile = max(images, key=lambda one: len(images[one]))
    return tile, np.asarray(Image.open(io.BytesIO(images[tile])))


def main(folder: Path, path: Path) -> None:
    image, (width, height) = shaded(folder / "mosaic")
    tile, pixels = finest_tile(next((folder / "pmtiles").glob("*.pmtiles")))
    figure, (left, right) = plt.subplots(1, 2, figsize=(10, 5), layout="constrained")
    left.imshow(image, extent=(0, width, 0, height), interpolation="nearest")
    left.set_title("mosaic: heights, shaded by the normals, and roads", fontsize=10)
    left.set(xlabel="m", ylabel="m")
    right.imshow(pixels)
    right.set_title(f"pmtiles: the map tile {'/'.join(map(str, tile))}", fontsize=10)
    right.set(xlabel="pixel", ylabel="pixel")
    figure.savefig(path, dpi=90)
    Image.open(path).convert("RGB").quantize(200, dither=0).save(path, optimize=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
