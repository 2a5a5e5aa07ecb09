"""Draw the meshes of a folder: ``python mesh_view.py FOLDER`` writes a ``.png`` next to each ``.npz``.

A separate program, never imported, because VTK ends its process if OpenGL is missing.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyvista as pv
from numpy.typing import NDArray
from PIL import Image

SIZE_PX = (480, 340)
"""Default width and height of a picture."""
OVERSAMPLING = 3
"""Factor of the size at which pictures are drawn, for thin, even lines."""
EXAGGERATION = 1.5
"""Factor of the heights; without it roads look flat."""

ROAD, TERRAIN, EDGE, SKY = "#3b3f46", "#ddd6c4", "#6f6753", "#ffffff"
DENSE_PX = 5.0
"""Edges of smaller triangles are drawn fainter: else the terrain would look black."""


def main(folder: Path) -> str:
    """Draw every mesh of the folder; return the errors, or an empty string."""
    errors = []
    for file in sorted(folder.glob("*.npz")):
        try:
            with np.load(file) as arrays:
                picture = draw(**arrays)
        except Exception as error:
            # A damaged mesh must not prevent the other pictures.
            errors.append(f"{file.name}: {error!r}")
            continue
        temporary = file.with_suffix(".part")
        picture.save(temporary, format="png")
        temporary.rename(file.with_suffix(".png"))
    return "; ".join(errors)


def draw(
    vertices: NDArray[np.float64],
    faces: NDArray[np.int32],
    road: NDArray[np.bool_],
    colours: NDArray[np.uint8] | None = None,
    within: Sequence[float] | None = None,
    size_px: Sequence[int] = SIZE_PX,
) -> Image.Image:
    """Draw one mesh, seen obliquely from the south-south-west.

    - `vertices`: east, north and up, ``(V, 3)``, m.
    - `faces`: vertex indices, ``(F, 3)``, counter-clockwise seen from above.
    - `road`: true for road faces, ``(F,)``.
    - `colours`: red, green and blue at the vertices, ``(V, 3)``; by default road and terrain have one colour
      each.
    - `within`: west, south, east and north of the part to draw, in the vertices' coordinates (m).
    """
    whole = pv.PolyData.from_regular_faces(vertices * [1, 1, EXAGGERATION], faces)
    # Normals are computed on the complete mesh, so that no seam shows between road and terrain.
    whole.compute_normals(cell_normals=False, split_vertices=False, consistent_normals=False, inplace=True)
    whole.cell_data["road"] = road
    if colours is not None:
        whole.point_data["colours"] = colours
    if within is not None:
        west, south, east, north = within
        whole = whole.clip_box([west, east, south, north, *whole.bounds[4:]], invert=False).extract_surface(
            algorithm=None
        )
    size = [int(n) for n in size_px]
    plotter = pv.Plotter(off_screen=True, window_size=[n * OVERSAMPLING for n in size], lighting="none")
    plotter.set_background(SKY)
    if colours is None:
        _add_classes(plotter, whole, _edge_opacity(vertices, faces[~road]))
    else:
        # More ambient light than for plain colours, so that the colours match the colour bar.
        plotter.add_mesh(whole, scalars="colours", rgb=True, smooth_shading=True, ambient=0.6, diffuse=0.45)
    _set_scene(plotter, whole.bounds, size[0])
    picture = Image.fromarray(plotter.screenshot(return_img=True))
    plotter.close()
    return picture.resize(size, Image.Resampling.LANCZOS)


def _add_classes(plotter: Any, whole: Any, edge_opacity: float) -> None:
    """Add the terrain with edges and the road without edges."""
    road = np.asarray(whole.cell_data["road"], dtype=bool)
    if not road.all():
        plotter.add_mesh(
            whole.extract_cells(~road),
            color=TERRAIN,
            smooth_shading=True,
            show_edges=True,
            edge_color=EDGE,
            edge_opacity=edge_opacity,
            line_width=1,
            ambient=0.25,
            diffuse=0.8,
        )
    if road.any():
        plotter.add_mesh(whole.extract_cells(road), color=ROAD, smooth_shading=True, ambient=0.3, diffuse=0.8)


def _edge_opacity(vertices: NDArray[np.float64], faces: NDArray[np.int32]) -> float:
    """Return the opacity of the edges; larger triangles in the picture have a higher opacity."""
    sides = vertices[faces] - vertices[np.roll(faces, 1, axis=1)]
    width = np.ptp(vertices[:, 0]) or 1.0
    side_px = float(np.median(np.linalg.norm(sides, axis=2))) / width * SIZE_PX[0] * 0.8
    return float(np.clip(side_px / DENSE_PX, 0.1, 1.0)) * 0.7


def _set_scene(plotter: Any, bounds: tuple[float, ...], width_px: int) -> None:
    """Add lights and camera: sun in the north-west like on the maps, camera in the south-south-west."""
    west, east, south, north, low, high = bounds
    middle = np.array([(west + east) / 2, (south + north) / 2, (low + high) / 2])
    size = float(np.hypot(east - west, north - south))
    plotter.add_light(pv.Light(position=tuple(middle + size * np.array([-1, 1, 1.2])), intensity=1.0))
    plotter.add_light(pv.Light(position=tuple(middle + size * np.array([0.5, -1, 1])), intensity=0.45))
    plotter.camera_position = [tuple(middle + size * np.array([-0.35, -1.0, 0.8])), tuple(middle), (0, 0, 1)]
    plotter.camera.view_angle = 30
    plotter.reset_camera(bounds=bounds)
    plotter.camera.zoom(1.3)
    plotter.add_text(
        f"seen from the south-south-west, heights x {EXAGGERATION:g}",
        position="lower_left",
        font_size=round(5 * OVERSAMPLING * width_px / SIZE_PX[0]),
        color="#555555",
    )


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))
