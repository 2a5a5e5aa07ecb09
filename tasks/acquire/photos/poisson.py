"""Oriented points -> mesh: Poisson surface reconstruction (Kazhdan & Hoppe, 2013), by COLMAP's binding.

The surface it finds is closed; where no points are near, it is made up and cut away.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from flexroad.tasks.acquire.mesh.sample import TexturedMesh
from flexroad.tasks.acquire.photos.mvs_cpu import Cloud
from flexroad.tasks.acquire.photos.sfm import colmap
from flexroad.tasks.errors import TaskError
from flexroad.tasks.types import Floats

CELLS = 2.0
"""Width of the octree's finest cells, in distances between points: with fewer points noise takes shape."""
FAR = 5.0
"""Vertices farther than this from every point, in distances between points, are made up."""
DEEPEST = 13
"""Levels of the octree that memory bears."""
RECORD = np.dtype(
    [(axis, "<f4") for axis in ("x", "y", "z", "nx", "ny", "nz")]
    + [(band, "u1") for band in ("red", "green", "blue")]
)
HEAD = """ply
format binary_little_endian 1.0
element vertex {}
{}
end_header
"""


def poisson(
    cloud: Cloud, spacing_m: float, crs: str, origin: Floats, work: Path, threads: int | None = None
) -> TexturedMesh:
    """Return the surface of a cloud with colours at its vertices.

    Parameters
    ----------
    cloud : Cloud
        Points about ``spacing_m`` apart, with normals.
    spacing_m : float
        Distance between neighbouring points (m).
    crs, origin : str, Floats
        Where the cloud's zero lies: easting, northing, height, ``(3,)``, m.
    work : Path
        Folder for the two files COLMAP wants.
    threads : int, optional
        All cores by default.

    Raises
    ------
    TaskError
        If pycolmap is missing, or there are too few points for a surface.
    """
    import trimesh

    pycolmap = colmap()
    write_ply(work / "cloud.ply", cloud)
    span = float(np.ptp(cloud.points, axis=0).max()) if len(cloud) else 0.0
    depth = math.ceil(math.log2(max(1.1 * span / (CELLS * spacing_m), 2)))
    options = pycolmap.PoissonMeshingOptions(
        depth=min(depth, DEEPEST), trim=0.0, color=True, num_threads=threads or -1
    )
    pycolmap.poisson_meshing(work / "cloud.ply", work / "mesh.ply", options)
    mesh = trimesh.load(work / "mesh.ply", process=False)
    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    distance, _ = cKDTree(cloud.points).query(vertices, distance_upper_bound=FAR * spacing_m)
    faces = faces[np.isfinite(distance)[faces].all(axis=1)]
    if not len(faces):
        raise TaskError(f"{len(cloud)} points make no surface; take photographs that overlap more")
    return TexturedMesh(
        crs=crs,
        vertices=vertices + origin,
        faces=faces.astype(np.int32),
        texture=np.full(len(faces), -1, np.int32),
        colours=np.asarray(mesh.visual.vertex_colors)[faces, :3],
    )


def write_ply(path: Path, cloud: Cloud) -> None:
    """Write points, normals and colours as binary PLY."""
    records = np.empty(len(cloud), RECORD)
    for names, values in (
        ("xyz", cloud.points),
        (("nx", "ny", "nz"), cloud.normals),
        (("red", "green", "blue"), cloud.colours),
    ):
        for name, column in zip(names, values.T, strict=True):
            records[name] = column
    kinds = {"<f4": "float", "|u1": "uchar"}
    lines = "\n".join(f"property {kinds[RECORD[name].str]} {name}" for name in RECORD.names or ())
    path.write_bytes(HEAD.format(len(cloud), lines).encode() + records.tobytes())
