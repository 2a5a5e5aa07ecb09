"""Vertices of exported files, read literally by the formats' specifications."""

import gzip
import json
from xml.etree import ElementTree

import numpy as np
import shapely
import trimesh
from pyproj import Transformer

from flexroad.tasks.spline.stepped import without_steps
from flexroad.tools.export.source import select

OFFSET_M = 47.5
"""Height of the vertical datum above the ellipsoid in the exports of the tests (m)."""
SAME_M = 0.003
"""Distance in plan by which formats move a vertex at most (m)."""
NAMESPACE = "{http://www.landxml.org/schema/LandXML-1.2}"


def true_heights(city, places):
    """The heights of the fitted surfaces at places, ``(n, 2)``."""
    return _heights(city, places, lambda surface: surface)


def spline_heights(city, places):
    """The same without the steps beside roads."""
    return _heights(city, places, without_steps)


def _heights(city, places, part):
    heights = np.full(len(places), np.nan)
    for tile in select(city).finished():
        west, south, east, north = tile.tile.grid.bounds
        x, y = places.T
        inside = (west <= x) & (x <= east) & (south <= y) & (y <= north)
        heights[inside] = part(tile.surface).height(x[inside], y[inside])
    return heights


def off_surface(city, points):
    """How far points, ``(n, 3)``, are above or below the surface, with or without steps beside roads."""
    # A vertex at the corner of cells or on a border of tiles has the step of one of them, and rounding may
    # move it to another.
    corners = [(0.0, 0.0), *((x, y) for x in (-SAME_M, SAME_M) for y in (-SAME_M, SAME_M))]
    here = spline_heights(city, points[:, :2])
    heights = [here]
    for corner in corners:
        moved = points[:, :2] + corner
        for place in (moved, on_borders(city, moved)):
            spline = spline_heights(city, place)
            # Just outside the run, the height is the border's.
            heights.append(np.where(np.isnan(here), spline, here))
            heights.append(heights[-1] + true_heights(city, place) - spline)
    return np.nanmin(np.abs(points[:, 2] - np.array(heights)), axis=0)


def on_borders(city, places):
    """The places, ``(n, 2)``, with those near a border of tiles moved onto it."""
    bounds = np.array([tile.tile.grid.exact_bounds for tile in select(city).finished()])
    moved = places.copy()
    for axis in (0, 1):
        for border in np.unique(bounds[:, [axis, axis + 2]]):
            near = np.abs(moved[:, axis] - border) <= 2 * SAME_M
            moved[near, axis] = border
    return moved


def landxml(path):
    text = gzip.decompress(path.read_bytes()) if path.suffix == ".gz" else path.read_bytes()
    root = ElementTree.fromstring(text)
    rows = [[float(number) for number in point.text.split()] for point in root.iter(f"{NAMESPACE}P")]
    north, east, height = np.array(rows).T
    return np.column_stack([east, north, height])


def cityjson(path):
    head, *features = map(json.loads, path.read_text().splitlines())
    scale, shift = (np.array(head["transform"][name]) for name in ("scale", "translate"))
    return np.concatenate([np.array(feature["vertices"]) * scale + shift for feature in features])


def obj(folder):
    points = []
    for file in sorted(folder.glob("*.obj")):
        origin = json.loads(file.with_suffix(".json").read_text())["origin"]
        lines = [line.split()[1:] for line in file.read_text().splitlines() if line.startswith("v ")]
        points.append(np.array(lines, float) + origin)
    return np.concatenate(points)


def entries(folder, file="tileset.json", transform=None, above=None):
    """Yield each tile's entry, its GLB file, the product of the transforms, and the entry above it."""
    path = folder / file
    todo = [(json.loads(path.read_text())["root"], np.eye(4) if transform is None else transform, above)]
    while todo:
        entry, outer, parent = todo.pop()
        matrix = outer @ np.reshape(entry.get("transform", np.eye(4)), (4, 4)).T
        uri = entry.get("content", {}).get("uri", "")
        if uri.endswith(".json"):
            yield from entries(folder, (path.parent / uri).relative_to(folder), matrix, entry)
        else:
            yield entry, (path.parent / uri).resolve() if uri else None, matrix, parent
        todo += [(child, matrix, entry) for child in entry.get("children", ())]


def mesh_of(file, matrix):
    """The mesh of a GLB file in coordinates from the Earth's centre, as viewers place it."""
    mesh = trimesh.load_scene(file, process=False).to_geometry()
    east, up, south = mesh.vertices.T
    return np.column_stack([east, -south, up]) @ matrix[:3, :3].T + matrix[:3, 3], mesh.faces


def from_earth(points, crs="EPSG:25832"):
    """From the Earth's centre to easting, northing and height of the run."""
    plan = Transformer.from_crs("EPSG:4978", crs, always_xy=True).transform(*points.T)[:2]
    height = Transformer.from_crs("EPSG:4978", "EPSG:4979", always_xy=True).transform(*points.T)[2]
    return np.column_stack([*plan, height - OFFSET_M])


def tiles3d(folder, crs):
    """The vertices of all tiles by the tilesets, back in the CRS of the run."""
    tiles = [item for item in entries(folder) if item[1] and item[1].parent.name == "tiles"]
    return np.concatenate([from_earth(mesh_of(file, matrix)[0], crs) for _, file, matrix, _ in tiles])


def vertices(out, crs="EPSG:25832"):
    return {
        "3dtiles": tiles3d(out / "3dtiles", crs),
        "landxml": landxml(next((out / "landxml").iterdir())),
        "cityjson": cityjson(next((out / "cityjson").iterdir())),
        "obj": obj(out / "obj"),
    }


def on_mesh(vertices, faces, easting, northing):
    """Return the heights of a mesh at places."""
    corners = vertices[faces]
    tree = shapely.STRtree(shapely.polygons(corners[:, :, :2]))
    point, face = tree.query(shapely.points(easting, northing), predicate="intersects")
    height = np.full(len(easting), np.nan)
    a, b, c = corners[face].transpose(1, 0, 2)
    u, v, w = b - a, c - a, np.column_stack([easting, northing])[point] - a[:, :2]
    area = u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]
    p = (w[:, 0] * v[:, 1] - w[:, 1] * v[:, 0]) / area
    q = (u[:, 0] * w[:, 1] - u[:, 1] * w[:, 0]) / area
    height[point] = a[:, 2] + p * u[:, 2] + q * v[:, 2]
    return height
