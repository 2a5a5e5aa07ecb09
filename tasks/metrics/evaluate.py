"""Compare a mesh with the reference: the paper's "Evaluation Metrics".

Distances are vertical, at the reference's cell centres in the tile's core. The evaluation mask classes cells,
and faces by the cell under their centroid, as road or terrain. It is the reference's road mask, else the raw
segmented mask; the paper uses the segmented mask.

Only a mesh without faults (`tasks.metrics.mesh_check`) is measured, so that a tile with a broken mesh fails.

Each level of a mesh is checked. Only level 0 is measured, without the cells below decks, because no layer has
their height.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np
from pydantic import Field

from flexroad.tasks import options as base
from flexroad.tasks.metrics import mesh_check
from flexroad.tasks.metrics.dihedral import mean_angles
from flexroad.tasks.metrics.mesh_distance import drape, nearest
from flexroad.tasks.roads.rasterise import cells
from flexroad.tasks.spline.moving import MovingNurbs
from flexroad.tasks.types import Bools, Floats, Mesh, Metrics, RoadMask, Surface, TileData

VERSION = 3

GAUSSIAN = 1.4826
"""Standard deviation of a Gaussian divided by its median absolute deviation."""
OFF_CENTRE = 0.25
"""Offset of the measured places from their cell centre, to the east and to the north (cells). At centres and
corners of cells and half-way between, meshes have vertices, which lie on the surface by construction."""
FIGURES = ("mesh_p95_road_m", "mesh_max_road_m", "mesh_p95_terrain_m", "mesh_max_terrain_m")
"""Names of the distances in `Metrics`."""


class Options(base.Options):
    """Optional metrics, the mask that classes cells as road, and the heights that are taken as true."""

    nearest: bool = Field(False, description="also measure 3-D distances (slower)")
    classes: Literal["reference", "segmented"] = Field(
        "reference",
        description="mask of the road cells. reference: the true mask, else the raw segmented mask; "
        "segmented: the raw segmented mask, as in the paper",
    )
    truth: Literal["reference", "dsm"] = Field(
        "reference",
        description="heights with which the mesh is compared. reference: the catalog's, else the DTM; "
        "dsm: the DSM",
    )


def evaluate(mesh: Mesh, data: TileData, road: RoadMask, surface: Surface, options: Options) -> Metrics:
    """Measure accuracy, smoothness (Eq. mad) and size of a mesh, and its distance from its surface.

    Parameters
    ----------
    data : TileData
        Reference heights, else the DTM, are the truth, or with ``truth: dsm`` the DSM.
    road : RoadMask
        Its raw mask classes the cells with ``classes: segmented``, or if the tile has no reference mask.
        The distance from the surface always uses the raw mask, with which the mesh was sampled.
    surface : Surface
        The surface that the mesh samples.
    options : Options
        Whether to measure 3-D distances, which mask classes the cells, and which heights are true.

    Returns
    -------
    Metrics
        Metres and degrees. Distances are over the cells where both mesh and reference have a height. A class
        without such cells has NaN.

    Raises
    ------
    MeshFault
        If the mesh of a level is not a height field triangulated once.
    """
    for number in mesh.numbers:
        mesh_check.check(mesh.at(number))
    triangles, mesh = len(mesh.faces), mesh.at(0)
    truth = data.dtm if data.reference is None else data.reference
    if options.truth == "dsm":
        truth = data.dsm
    reference_road = data.reference_road if options.classes == "reference" else None
    is_road = road.mask if reference_road is None else reference_road
    window = data.grid.window(data.core)
    heights = np.ascontiguousarray(truth[window]) - mesh.origin[2]
    if road.levels:
        decks = [level.areas for level in road.levels if level.number > 0]
        heights[cells(np.array(decks, object), road.core)] = np.nan
    difference = drape(mesh, data.core) - heights
    has_truth, has_both = np.isfinite(heights), np.isfinite(difference)
    classes = is_road[window], ~is_road[window]
    on_road, on_terrain = (difference[has_both & of_class] for of_class in classes)
    distances_3d = (
        _distances_3d(mesh, data, heights, difference)
        if options.nearest
        else np.full(difference.shape, np.nan)
    )
    angles = _angles(mesh, data, is_road)
    return Metrics(
        l2_road_m=mean(np.abs(on_road)),
        l2_terrain_m=mean(np.abs(on_terrain)),
        rmse_road_m=float(np.sqrt(mean(on_road**2))),
        rmse_terrain_m=float(np.sqrt(mean(on_terrain**2))),
        nmad_road_m=nmad(on_road),
        p95_road_m=percentile(np.abs(on_road), 95),
        nearest_road_m=mean(distances_3d[has_both & classes[0]]),
        nearest_terrain_m=mean(distances_3d[has_both & classes[1]]),
        mad_road_deg=angles[0],
        mad_terrain_deg=angles[1],
        triangles=triangles,
        road_fraction=mean(is_road[window][has_truth]),
        completeness=mean(has_both[has_truth]),
        **mesh_distances(mesh, surface, road),
    )


def _distances_3d(mesh: Mesh, data: TileData, heights: Floats, difference: Floats) -> Floats:
    """Return the 3-D distance of each cell that has a vertical distance, ``(H, W)``, m; else NaN."""
    row, col = np.nonzero(np.isfinite(difference))
    east, north = data.core.eastings[col] - mesh.origin[0], data.core.northings[row] - mesh.origin[1]
    points = np.column_stack([east, north, heights[row, col]])
    out = np.full(difference.shape, np.nan)
    out[row, col] = nearest(mesh.vertices, mesh.faces, points, np.abs(difference[row, col]))
    return out


def _angles(mesh: Mesh, data: TileData, is_road: Bools) -> tuple[float, float]:
    """Return the mean angle to neighbouring faces (degrees) of road faces and of terrain faces.

    For a class with cells but without faces, such as the road of a two-face plane, all faces are used.
    """
    per_face = mean_angles(mesh)
    x, y = (mesh.vertices[:, axis][mesh.faces].mean(axis=1) + mesh.origin[axis] for axis in (0, 1))
    face_is_road = is_road[data.grid.cells(x, y)]
    core_is_road = is_road[data.grid.window(data.core)]
    means = []
    for faces, of_class in ((face_is_road, core_is_road), (~face_is_road, ~core_is_road)):
        chosen = per_face[faces] if faces.any() else per_face
        chosen = chosen[np.isfinite(chosen)]
        means.append(mean(chosen) if of_class.any() else float("nan"))
    return means[0], means[1]


def mesh_distances(mesh: Mesh, surface: Surface, road: RoadMask) -> dict[str, float]:
    """Return the vertical distances of a mesh from its surface, steps included, by the names `FIGURES` (m).

    - `road`: its raw mask classes the places; each cell of the core has one place.
    - result: 95th percentile and largest distance per class; NaN for a class without a place on the mesh, and
      for a surface whose heights are not above their places (`MovingNurbs`).
    """
    if isinstance(surface, MovingNurbs):
        return dict.fromkeys(FIGURES, float("nan"))
    core = road.core
    shift = OFF_CENTRE * core.cell
    places = replace(core, west=core.west + shift, north=core.north + shift)
    heights = surface.lattice(places.eastings, places.northings) - mesh.origin[2]
    distances = np.abs(drape(mesh, places) - heights)
    is_road, known = road.mask[road.grid.window(core)], np.isfinite(distances)
    parts = [distances[known & cells] for cells in (is_road, ~is_road)]
    figures = (percentile(part, percent) for part in parts for percent in (95, 100))
    return dict(zip(FIGURES, figures, strict=True))


def mean(values: Floats | Bools) -> float:
    """Return the mean; NaN if there are no values."""
    return float(values.mean()) if values.size else float("nan")


def nmad(values: Floats) -> float:
    """Return the normalised median absolute deviation from the median; NaN if there are no values."""
    return float(GAUSSIAN * np.median(np.abs(values - np.median(values)))) if values.size else float("nan")


def percentile(values: Floats, percent: float) -> float:
    """Return a percentile; NaN if there are no values."""
    return float(np.percentile(values, percent)) if values.size else float("nan")
