"""Draw docs/images/export.webp: the files of an export as other programs read them.

``PYTHONPATH=. python experiments/export_pictures.py EXPORT docs/images/export.webp``, where ``EXPORT`` has
``landxml``, ``cityjson``, ``obj``, ``heightfield``, ``step`` and ``3dm`` of one run.
"""

import json
import sys
from collections.abc import Callable
from itertools import product, starmap
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pyvista as pv
import rhino3dm
from geomdl import BSpline
from PIL import Image

from tests.tasks.export.test_step import read_surface

SIZE_PX = (520, 330)
OVERSAMPLING = 2
EXAGGERATION = 2.0
ROAD, TERRAIN, EDGE = "#3b3f46", "#ddd6c4", "#8d8471"
NAMESPACE = "{http://www.landxml.org/schema/LandXML-1.2}"
SHADE = {"ambient": 0.35, "diffuse": 0.85}
Plot = Callable[[pv.Plotter, Path], None]


def triangles(vertices: np.ndarray, faces: np.ndarray) -> pv.PolyData:
    """Return a mesh with heights drawn larger."""
    return pv.PolyData.from_regular_faces(vertices * [1, 1, EXAGGERATION], faces)


def grid(points: np.ndarray) -> pv.StructuredGrid:
    """Return a grid of points, ``(rows, columns, 3)``."""
    return pv.StructuredGrid(*np.moveaxis(points * [1, 1, EXAGGERATION], -1, 0))


def landxml(plotter: pv.Plotter, folder: Path) -> None:
    """The edges of the triangles of both surfaces, by a reader of XML."""
    (file,) = (folder / "landxml").glob("*.xml")
    for surface in ElementTree.parse(file).iter(f"{NAMESPACE}Surface"):
        rows = {p.get("id"): p.text.split() for p in surface.iter(f"{NAMESPACE}P")}
        number = {name: k for k, name in enumerate(rows)}
        points = np.array(list(rows.values()), float)[:, [1, 0, 2]]
        faces = np.array([[number[n] for n in f.text.split()] for f in surface.iter(f"{NAMESPACE}F")])
        road = surface.get("name") == "road"
        plotter.add_mesh(
            triangles(points, faces),
            color="#f3efe4" if not road else "#c9cdd3",
            show_edges=True,
            edge_color="#a89d83" if not road else "#1f4e79",
            line_width=1,
            **SHADE,
        )


def cityjson(plotter: pv.Plotter, folder: Path) -> None:
    """Roads and terrain by their type, by a reader of JSON; each tile has another shade."""
    (file,) = (folder / "cityjson").glob("*.jsonl")
    head, *features = map(json.loads, file.read_text().splitlines())
    scale, shift = (np.array(head["transform"][name]) for name in ("scale", "translate"))
    shades = {
        "Road": ["#33373d", "#4a5059", "#3f444c", "#565d67"],
        "TINRelief": ["#b9cfa4", "#a8c294", "#c9d8b3", "#9db989"],
    }
    seen = dict.fromkeys(shades, 0)
    for feature in features:
        points = np.array(feature["vertices"]) * scale + shift
        for item in feature["CityObjects"].values():
            (geometry,) = item["geometry"]
            faces = np.array(geometry["boundaries"])[:, 0]
            colour = shades[item["type"]][seen[item["type"]] % 4]
            seen[item["type"]] += 1
            plotter.add_mesh(triangles(points, faces), color=colour, **SHADE)


def obj(plotter: pv.Plotter, folder: Path) -> None:
    """The meshes with their photo, by VTK's reader."""
    for file in sorted((folder / "obj").glob("*.obj")):
        place = json.loads(file.with_suffix(".json").read_text())
        mesh = pv.read(file).translate(place["origin"]).scale([1, 1, EXAGGERATION])
        photo = file.with_suffix(".jpg")
        texture = pv.read_texture(photo) if photo.exists() else None
        plotter.add_mesh(mesh, texture=texture, color=None if texture else TERRAIN, **SHADE)


def heightfield(plotter: pv.Plotter, folder: Path) -> None:
    """The values of the pictures as heights and grey levels, by Pillow."""
    files = sorted((folder / "heightfield").glob("*_heightfield.json"))
    places = [json.loads(file.read_text()) for file in files]
    fields = [np.asarray(Image.open(file.with_suffix(".png")), float) for file in files]
    heights = [p["low_m"] + v * p["step_m"] for p, v in zip(places, fields, strict=True)]
    limits = [min(h.min() for h in heights), max(h.max() for h in heights)]
    for place, values in zip(places, heights, strict=True):
        west, south, east, north = place["bounds"]
        columns, rows = place["size"]
        x, y = np.meshgrid(np.linspace(west, east, columns), np.linspace(north, south, rows))
        surface = grid(np.dstack([x, y, values]))
        surface["height"] = values.T.ravel()
        shades = {"cmap": "gray", "n_colors": 1024, "clim": limits}
        plotter.add_mesh(surface, **shades, show_scalar_bar=False, lighting=False)


def step(plotter: pv.Plotter, folder: Path) -> None:
    """The surface and its knot lines, by geomdl."""
    for file in sorted((folder / "step").glob("*.stp")):
        place = json.loads(file.with_name(f"{file.stem}_stp.json").read_text())
        surface = read_surface(file.read_text())
        points = evaluated(surface, np.linspace(0, 1, 71), np.linspace(0, 1, 71)) + place["origin"]
        plotter.add_mesh(grid(points), color="#c8d7e6", smooth_shading=True, **SHADE)
        for u, v in ((surface.knotvector_u, None), (None, surface.knotvector_v)):
            for knot in np.unique(u or v)[::4]:
                ends = np.linspace(0, 1, 71)
                line = evaluated(surface, [knot] if u else ends, ends if u else [knot]).reshape(-1, 3)
                shown = (line + place["origin"]) * [1, 1, EXAGGERATION] + (0, 0, 0.3)
                plotter.add_mesh(pv.lines_from_points(shown), color="#2a6f97", line_width=1)


def evaluated(surface: BSpline.Surface, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Return points of a surface, ``(len(u), len(v), 3)``."""
    return np.array([surface.evaluate_list([(a, b) for b in v]) for a in u])


def rhino(plotter: pv.Plotter, folder: Path) -> None:
    """Control points of the surface over the meshes of road and terrain, by rhino3dm."""
    for file in sorted((folder / "3dm").glob("*.3dm")):
        model = rhino3dm.File3dm.Read(str(file))
        x, y, *_ = (float(v) for v in model.Strings["origin"].split())
        layers = {layer.Index: layer.Name for layer in model.Layers}
        for item in model.Objects:
            geometry, layer = item.Geometry, layers[item.Attributes.LayerIndex]
            if isinstance(geometry, rhino3dm.NurbsSurface):
                net = geometry.Points
                places = product(range(0, net.CountU, 3), range(0, net.CountV, 3))
                points = np.array([(p.X + x, p.Y + y, p.Z) for p in starmap(net.GetControlPoint, places)])
                shown = points * [1, 1, EXAGGERATION] + np.array([0, 0, 1])
                plotter.add_points(shown, color="#d1495b", point_size=2 * OVERSAMPLING)
            else:
                vertices = np.array([(p.X + x, p.Y + y, p.Z) for p in geometry.Vertices])
                faces = np.array([geometry.Faces[k][:3] for k in range(len(geometry.Faces))])
                colour = ROAD if layer == "road" else TERRAIN
                plotter.add_mesh(triangles(vertices, faces), color=colour, **SHADE)


PANELS: dict[str, Plot] = {
    "LandXML: triangles of road and ground": landxml,
    "CityJSON: Road and TINRelief per tile": cityjson,
    "OBJ: meshes with their photo": obj,
    "height fields: 16-bit grey levels": heightfield,
    "STEP: B-spline surface, every 4th knot line": step,
    "3DM: every 3rd control point, and the meshes": rhino,
}


def drawn(title: str, plot: Plot, folder: Path) -> Image.Image:
    """Return the picture of one panel."""
    plotter = pv.Plotter(off_screen=True, window_size=[n * OVERSAMPLING for n in SIZE_PX], lighting="none")
    plotter.set_background("white")
    plot(plotter, folder)
    west, east, south, north, low, high = plotter.bounds
    middle = np.array([(west + east) / 2, (south + north) / 2, (low + high) / 2])
    reach = float(np.hypot(east - west, north - south))
    for direction, power in (((-1, 1, 0.8), 0.8), ((0.5, -1, 1), 0.35)):
        position = middle + reach * np.array(direction)
        plotter.add_light(pv.Light(position=tuple(position), focal_point=tuple(middle), intensity=power))
    eye = middle + reach * np.array([-0.35, -1.0, 0.8])
    plotter.camera_position = [tuple(eye), tuple(middle), (0, 0, 1)]
    plotter.camera.view_angle = 30
    plotter.reset_camera(bounds=plotter.bounds)
    plotter.camera.zoom(1.55)
    plotter.add_text(title, position="upper_left", font_size=8 * OVERSAMPLING, color="#333333")
    picture = Image.fromarray(plotter.screenshot(return_img=True))
    plotter.close()
    return picture.resize(SIZE_PX, Image.Resampling.LANCZOS)


def main(folder: Path, file: Path) -> None:
    """Write the picture."""
    width, height = SIZE_PX
    picture = Image.new("RGB", (3 * width, 2 * height), "white")
    for k, (title, plot) in enumerate(PANELS.items()):
        picture.paste(drawn(title, plot, folder), (k % 3 * width, k // 3 * height))
    picture.save(file, quality=88)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
