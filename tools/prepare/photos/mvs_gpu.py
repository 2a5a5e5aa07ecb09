"""Dense stereo on a GPU: COLMAP's PatchMatch and fusion (Schönberger et al., 2016).

Needs a GPU and a pycolmap built with CUDA, as the package pycolmap-cuda12.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from pydantic import Field

from flexroad.tasks import options as base
from flexroad.tasks.errors import TaskError
from flexroad.tools.prepare.photos.mvs_cpu import Cloud
from flexroad.tools.prepare.photos.poisson import RECORD
from flexroad.tools.prepare.photos.sfm import Reconstruction, colmap


class Options(base.Options):
    """Options of dense stereo on a GPU."""

    size: int = Field(2000, ge=100, description="photographs are reduced to this width or height (px)")


def available() -> bool:
    """Return whether pycolmap was built with CUDA and finds a GPU; raises TaskError if it is missing."""
    pycolmap = colmap()
    return bool(pycolmap.has_cuda) and pycolmap.get_num_cuda_devices() > 0


def patchmatch(reconstruction: Reconstruction, work: Path, options: Options) -> Cloud:
    """Return the fused cloud of all photographs, relative to the reconstruction's origin.

    - `reconstruction`: its model and photographs are read from their files.
    - `work`: folder for undistorted photographs and depth maps: about 20 bytes per pixel of each photograph.
    """
    pycolmap = colmap()
    workspace, fused = work / "stereo", work / "fused.ply"
    undistorting = pycolmap.UndistortCameraOptions(max_image_size=options.size)
    pycolmap.undistort_images(
        workspace, reconstruction.model, reconstruction.root, undistort_options=undistorting
    )
    pycolmap.patch_match_stereo(workspace, options=pycolmap.PatchMatchOptions(max_image_size=options.size))
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
