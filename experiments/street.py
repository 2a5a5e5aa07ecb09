"""A real street in 3D before and after: the picture at the top of the README.

Before is the surface model with its trees, as a scan gives it; after is the surface of ``production``, fitted
to it, the terrain model and the land cover. The data are the UMEP tutorial's rasters of the Barbican, London
(doi:10.1016/j.envsoft.2017.09.020), unpacked from ``London_BNG.zip``.

Usage: ``python experiments/street.py FOLDER OUT.webp`` (needs OpenGL)
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pyvista as pv
import rioxarray
import xarray as xr
from PIL import Image, ImageColor, ImageDraw, ImageFont

import flexroad

FITTED = (532040.0, 181625.0, 532290.0, 181875.0)
SHOWN = (532076.0, 181690.0, 532176.0, 181850.0)
"""West, south, east and north (m, EPSG:27700): Aldersgate Street."""
PAVED, TREE_M = 1, 2.0
ROAD, LAND, TREE, SKY = "#5d646e", "#ddd3bd", "#7fa35b", "#ffffff"
SIZE_PX, OVERSAMPLING, QUALITY = (720, 560), 2, 86


def read(path: Path) -> xr.DataArray:
    raster = rioxarray.open_rasterio(path, masked=True).squeeze("band", drop=True)
    return raster.rio.clip_box(*FITTED).astype("float64")


def sheet(heights: xr.DataArray, kinds: np.ndarray) -> pv.StructuredGrid:
    """Return the cells of a raster as one surface; kinds are 0 land, 1 road, 2 tree."""
    part = heights.rio.clip_box(*SHOWN)
    east, north = np.meshgrid(part.x.values - SHOWN[0], part.y.values - SHOWN[1])
    grid = pv.StructuredGrid(east, north, part.values)
    grid["colour"] = kinds.ravel(order="F")
    return grid


def draw(heights: xr.DataArray, colours: xr.DataArray, title: str) -> Image.Image:
    palette = np.array([ImageColor.getrgb(name) for name in (LAND, ROAD, TREE)], np.uint8)
    kinds = colours.rio.clip_box(*SHOWN).values.astype(int)
    grid = sheet(heights, kinds)
    grid["rgb"] = palette[kinds.ravel(order="F")]
    plotter = pv.Plotter(off_screen=True, window_size=[n * OVERSAMPLING for n in SIZE_PX], lighting="none")
    plotter.set_background(SKY)
    plotter.add_mesh(grid, scalars="rgb", rgb=True, ambient=0.32, diffuse=0.75, smooth_shading=False)
    middle = np.array([(SHOWN[2] - SHOWN[0]) / 2, (SHOWN[3] - SHOWN[1]) / 2 - 6, 14.0])
    for at, light in (((-1, 1, 1.4), 0.95), ((1.2, -1, 1), 0.35)):
        plotter.add_light(pv.Light(position=tuple(middle + 300 * np.array(at)), intensity=light))
    plotter.camera_position = [tuple(middle + 212 * np.array([0.42, -0.86, 0.78])), tuple(middle), (0, 0, 1)]
    plotter.camera.view_angle = 32
    image = Image.fromarray(plotter.screenshot(return_img=True)).resize(SIZE_PX, Image.Resampling.LANCZOS)
    plotter.close()
    ImageDraw.Draw(image).text((16, 12), title, "#22303c", ImageFont.load_default(22))
    return image


def main(folder: Path, out: Path) -> None:
    dsm, dtm = (read(folder / f"{name}_barb_1m_tif.tif") for name in ("dsm", "dem"))
    trees, cover = read(folder / "cdsm_barb_1m_v2_float.tif"), read(folder / "landcover_barb_1m_v3.tif")
    trees = trees.assign_coords(x=dsm.x, y=dsm.y).fillna(0)
    paved = (cover == PAVED).assign_coords(x=dsm.x, y=dsm.y)
    scanned = dsm.where(trees < TREE_M, dsm + trees).rio.write_crs("EPSG:27700")
    road = paved.astype(float).rio.write_crs("EPSG:27700")
    surface = flexroad.fit(scanned, dtm.rio.write_crs("EPSG:27700"), road.astype("uint8"))
    east, north = np.meshgrid(dsm.x, dsm.y)
    smooth = scanned.copy(data=surface.height(east, north))
    before = draw(scanned, road.where(trees < TREE_M, 2), "before: the scan, 1 m")
    after = draw(smooth, road, "after: road and terrain of FlexRoad")
    both = Image.new("RGB", (2 * SIZE_PX[0], SIZE_PX[1]), SKY)
    both.paste(before, (0, 0))
    both.paste(after, (SIZE_PX[0], 0))
    both.save(out, quality=QUALITY, method=6)
    print(f"{out}: {out.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
