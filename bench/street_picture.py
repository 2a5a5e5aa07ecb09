"""A real street in 3D before and after: the picture at the top of the README.

Before is the scan with its photograph; after is the mesh of ``production_vector``, whose roads were drawn by
hand (``--set "segment.where=class = 'road' AND certainty <> 'low'"``). The data are a laser scan
of Eugene, Oregon (Watershed Sciences, PDAL/data, CC BY 4.0). The photograph is made from the colours of its
points, moved by 2 m onto its heights. Section "Autzen" of docs/results/real_data.md has the command that
makes the rasters.

Usage: ``python bench/street_picture.py RUN PHOTO.tif OUT.webp`` (needs OpenGL)
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pyvista as pv
import rioxarray
from PIL import Image, ImageColor, ImageDraw, ImageFont

import flexroad

TILE = "194250_259750"
SHOWN = (194252.0, 259838.0, 194472.0, 259978.0)
"""West, south, east and north (m, EPSG:2993): a street and the car parks beside it."""
ROAD, LAND, SKY = "#5d646e", "#ddd3bd", "#ffffff"
ROAD_CLASS = 11
"""ASPRS class of road surface in the PLY."""
SIZE_PX, OVERSAMPLING, QUALITY = (720, 400), 2, 86


def scanned(tile, photo: Path) -> pv.StructuredGrid:
    """Return the cells of the surface model with the colours of the photograph."""
    part = tile.dsm.rio.clip_box(*SHOWN)
    east, north = np.meshgrid(part.x.values, part.y.values)
    pixels = rioxarray.open_rasterio(photo).sel(band=[1, 2, 3]).sel(x=part.x, y=part.y, method="nearest")
    grid = pv.StructuredGrid(east - SHOWN[0], north - SHOWN[1], part.values)
    grid["rgb"] = pixels.values.reshape(3, *east.shape).transpose(2, 1, 0).reshape(-1, 3).astype(np.uint8)
    return grid


def meshed(path: Path) -> pv.PolyData:
    """Return the part of a tile's PLY that is shown, with a colour per face."""
    import trimesh

    mesh = trimesh.load(path, process=False)
    faces = mesh.metadata["_ply_raw"]["face"]["data"]
    vertices = mesh.vertices - (SHOWN[0], SHOWN[1], 0)
    inside = ((vertices[:, :2] >= 0) & (vertices[:, :2] <= np.subtract(SHOWN[2:], SHOWN[:2]))).all(axis=1)
    kept = inside[mesh.faces].all(axis=1)
    shown = pv.PolyData.from_regular_faces(vertices, mesh.faces[kept])
    palette = np.array([ImageColor.getrgb(name) for name in (LAND, ROAD)], np.uint8)
    shown.cell_data["rgb"] = palette[(np.ravel(faces["class"])[kept] == ROAD_CLASS).astype(int)]
    return shown


def draw(mesh: pv.DataSet, title: str, height: float) -> Image.Image:
    plotter = pv.Plotter(off_screen=True, window_size=[n * OVERSAMPLING for n in SIZE_PX], lighting="none")
    plotter.set_background(SKY)
    plotter.add_mesh(mesh, scalars="rgb", rgb=True, ambient=0.4, diffuse=0.7, smooth_shading=False)
    middle = np.array([(SHOWN[2] - SHOWN[0]) / 2, (SHOWN[3] - SHOWN[1]) / 2, height])
    for at, light in (((-1, 1, 1.4), 0.85), ((1.2, -1, 1), 0.35)):
        plotter.add_light(pv.Light(position=tuple(middle + 300 * np.array(at)), intensity=light))
    plotter.camera_position = [tuple(middle + 278 * np.array([-0.3, -0.8, 0.55])), tuple(middle), (0, 0, 1)]
    plotter.camera.view_angle = 30
    image = Image.fromarray(plotter.screenshot(return_img=True)).resize(SIZE_PX, Image.Resampling.LANCZOS)
    plotter.close()
    ImageDraw.Draw(image).text((16, 12), title, "#22303c", ImageFont.load_default(22))
    return image


def main(run: Path, photo: Path, out: Path) -> None:
    tile = flexroad.open_run(run).tile(TILE)
    height = float(np.nanmedian(tile.surface.rio.clip_box(*SHOWN)))
    before = draw(scanned(tile, photo), "before: the scan, with its photograph", height)
    after = draw(meshed(run / "tiles" / TILE / f"{TILE}_flexroad.ply"), "after: road and terrain", height)
    both = Image.new("RGB", (2 * SIZE_PX[0], SIZE_PX[1]), SKY)
    both.paste(before, (0, 0))
    both.paste(after, (SIZE_PX[0], 0))
    both.save(out, quality=QUALITY, method=6)
    print(f"{out}: {out.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:4]))
