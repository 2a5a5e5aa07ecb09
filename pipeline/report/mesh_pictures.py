"""Pictures of meshes, drawn in a child process, because VTK ends its process if OpenGL is missing."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from flexroad.catalog.grid import Bounds
from flexroad.catalog.storage.scratch import ScratchFolder
from flexroad.pipeline.report.render import _small, log
from flexroad.tasks.types import Mesh

CHILD_START_S, CHILD_MESH_S = 60.0, 15.0
"""Time limit of the child process: a fixed part, plus a part per mesh (s)."""


def render_meshes(
    meshes: Mapping[str, Mesh],
    colours: Mapping[str, NDArray[np.uint8]] | None = None,
    within: Bounds | None = None,
    size_px: tuple[int, int] | None = None,
) -> dict[str, bytes | None]:
    """Draw oblique views of meshes from the south, all in one child process.

    Parameters
    ----------
    meshes : Mapping of str to Mesh
        Meshes by name.
    colours : Mapping of str to ndarray, optional
        Red, green and blue at the vertices of each mesh, ``(V, 3)``; by default road and terrain have one
        colour each.
    within : Bounds, optional
        The part to draw (m, in the meshes' CRS); by default the complete mesh.
    size_px : tuple of int, optional
        Width and height of a picture.

    Returns
    -------
    dict
        A PNG by name, or None if it could not be drawn; the reason is logged as a warning. Heights are
        exaggerated by the factor given in the picture.
    """
    if not meshes:
        return {}
    with ScratchFolder() as name:
        folder = Path(name)
        for i, (mesh_name, mesh) in enumerate(meshes.items()):
            optional = {
                "colours": None if colours is None else colours[mesh_name],
                "within": None if within is None else np.subtract(within, mesh.origin[:2] * 2),
                "size_px": size_px,
            }
            given: dict[str, Any] = {key: value for key, value in optional.items() if value is not None}
            np.savez(folder / f"{i}.npz", vertices=mesh.vertices, faces=mesh.faces, road=mesh.road, **given)
        reason = _draw_in_child(folder, CHILD_START_S + CHILD_MESH_S * len(meshes))
        files = [folder / f"{i}.png" for i in range(len(meshes))]
        pictures = [_small(Image.open(file)) if file.exists() else None for file in files]
    by_name = dict(zip(meshes, pictures, strict=True))
    missing = [name for name, picture in by_name.items() if picture is None]
    if missing:
        log.warning("no mesh pictures of %s: %s", ", ".join(missing), reason)
    return by_name


def _draw_in_child(folder: Path, seconds: float) -> str:
    """Run the child process; return why it failed, or an empty string."""
    # Started by file, not by module: the child does not import flexroad and starts in half the time. With -P
    # the modules of this folder (steps, pages) cannot shadow others.
    command = [sys.executable, "-P", str(Path(__file__).with_name("mesh_view.py")), str(folder)]
    try:
        child = subprocess.run(command, capture_output=True, text=True, timeout=seconds, check=False)
    except subprocess.TimeoutExpired:
        return f"not finished after {seconds:.0f} s"
    if child.returncode < 0:
        return f"VTK ended with signal {-child.returncode}; is OpenGL (libegl1 or libosmesa6) installed?"
    lines = child.stderr.strip().splitlines()
    return lines[-1] if child.returncode and lines else ""
