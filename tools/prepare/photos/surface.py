"""Meshes from camera poses with pycolmap: a dense cloud on a GPU, and the surface of any dense cloud.

The cloud is COLMAP's PatchMatch stereo and fusion (Schönberger et al., 2016). It needs a GPU and a pycolmap
built with CUDA, such as the package pycolmap-cuda12. The surface is Poisson's (Kazhdan & Hoppe, 2013). It is
closed, so parts far from all points are wrong and are removed.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from flexroad.catalog.lazy import lazy
from flexroad.tasks.errors import TaskError
from flexroad.tasks.types import Floats
from flexroad.tools.prepare.mesh.sample import TexturedMesh
from flexroad.tools.prepare.photos.mvs_cpu import Cloud
from flexroad.tools.prepare.photos.sfm import Reconstruction, colmap

spatial = lazy("scipy.spatial")
trimesh = lazy("trimesh")

CELLS = 2.0
"""Width of the octree's finest cells, in distances between points; smaller cells would fit the noise."""
FAR = 5.0
"""Vertices farther than this from all points, in distances between points, are removed."""
DEEPEST = 13
"""Largest depth of the octree, to limit the memory."""
RECORD = np.dtype(
    [(axis, "<f4") for axis in ("x", "y", "z", "nx", "ny", "nz")]
    + [(band, "u1") for band in ("red", "green", "blue")]
)
HEADER = """ply
format binary_little_endian 1.0
element vertex {}
{}
end_header
"""


def has_gpu() -> bool:
    """Return whether pycolmap was built with CUDA and finds a GPU; raises TaskError if it is missing."""
    pycolmap = colmap()
    return bool(pycolmap.has_cuda) and pycolmap.get_num_cuda_devices() > 0


def patchmatch(reconstruction: Reconstruction, work: Path, size: int) -> Cloud:
    """Return the fused cloud of all photographs, relative to the reconstruction's origin.

    - `reconstruction`: its model and photographs are read from their files.
    - `work`: folder for undistorted photographs and depth maps: about 20 bytes per pixel of each photograph.
    - `size`: photographs are reduced to this width or height (pixels).
    """
    pycolmap = colmap()
    workspace, fused = work / "stereo", work / "fused.ply"
    undistorting = pycolmap.UndistortCameraOptions(max_image_size=size)
    pycolmap.undistort_images(
        workspace, reconstruction.model, reconstruction.root, undistort_options=undistorting
    )
    pycolmap.patch_match_stereo(workspace, options=pycolmap.PatchMatchOptions(max_image_size=size))
    pycolmap.stereo_fusion(fused, workspace, output_type="PLY")
    return read_ply(fused)


def read_ply(path: Path) -> Cloud:
    """Read the points from the PLY file of COLMAP's fusion."""
    _, _, body = path.read_bytes().partition(b"end_header\n")
    records = np.frombuffer(body, RECORD)
    if not len(records):
        raise TaskError("dense stereo gave no points; use photographs that overlap by 60 % or more")
    points, normals, colours = (
        np.column_stack([records[name] for name in names])
        for names in (("x", "y", "z"), ("nx", "ny", "nz"), ("red", "green", "blue"))
    )
    return Cloud(points.astype(np.float64), normals.astype(np.float64), colours)


def poisson(
    cloud: Cloud, spacing_m: float, crs: str, origin: Floats, work: Path, threads: int | None = None
) -> TexturedMesh:
    """Return the surface of a cloud as a mesh with vertex colours.

    - `cloud`: points about ``spacing_m`` apart, with normals.
    - `crs`, `origin`: CRS, and the position of the cloud's origin in it: easting, northing, height, ``(3,)``,
      m.
    - `work`: folder for two temporary PLY files.
    - `threads`: number of threads; by default one per core.
    """
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
    distance, _ = spatial.cKDTree(cloud.points).query(vertices, distance_upper_bound=FAR * spacing_m)
    faces = faces[np.isfinite(distance)[faces].all(axis=1)]
    if not len(faces):
        raise TaskError(f"{len(cloud)} points give no surface; use photographs that overlap more")
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
    path.write_bytes(HEADER.format(len(cloud), lines).encode() + records.tobytes())
