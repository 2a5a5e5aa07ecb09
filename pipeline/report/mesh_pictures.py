"""Pictures of meshes in space, drawn by a child process that a missing OpenGL library cannot take down."""

from __future__ import annotations

import subprocess
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from flexroad.catalog.grid import Bounds
from flexroad.pipeline.report.render import _small, log
from flexroad.tasks.types import Mesh

CHILD_START_S, CHILD_MESH_S = 60.0, 15.0
"""Time a child gets to start and for each mesh, before it is given up."""


def render_meshes(
    meshes: Mapping[str, Mesh],
    colours: Mapping[str, NDArray[np.uint8]] | None = None,
    within: Bounds | None = None,
    size_px: tuple[int, int] | None = None,
) -> dict[str, bytes | None]:
    """Draw meshes seen obliquely from the south, all in one child process.

    Parameters
    ----------
    meshes : Mapping of str to Mesh
        By any name.
    colours : Mapping of str to ndarray, optional
        By the same names, ``(V, 3)``: red, green and blue at the vertices, in place of the colours of road
        and terrain.
    within : Bounds, optional
        The part that is drawn (m, in the meshes' CRS).
    size_px : tuple of int, optional
        Width and height of a picture.

    Returns
    -------
    dict
        The same names with a PNG each, or None where none could be drawn; the reason is logged as a warning.
        Heights are drawn larger than they are, by the factor the picture states.
    """
    if not meshes:
        return {}
    with tempfile.TemporaryDirectory(prefix="flexroad-") as name:
        folder = Path(name)
        for i, (mesh_name, mesh) in enumerate(meshes.items()):
            asked = {
                "colours": None if colours is None else colours[mesh_name],
                "within": None if within is None else np.subtract(within, mesh.origin[:2] * 2),
                "size_px": size_px,
            }
            further: dict[str, Any] = {key: value for key, value in asked.items() if value is not None}
            np.savez(folder / f"{i}.npz", vertices=mesh.vertices, faces=mesh.faces, road=mesh.road, **further)
        reason = _draw_in_child(folder, CHILD_START_S + CHILD_MESH_S * len(meshes))
        files = [folder / f"{i}.png" for i in range(len(meshes))]
        pictures = [_small(Image.open(file)) if file.exists() else None for file in files]
    drawn = dict(zip(meshes, pictures, strict=True))
    lost = [name for name, picture in drawn.items() if picture is None]
    if lost:
        log.warning("no mesh pictures of %s: %s", ", ".join(lost), reason)
    return drawn


def _draw_in_child(folder: Path, seconds: float) -> str:
    """Run the child and return why it failed, or nothing."""
    # By file, not by module: the child then imports nothing of ours and starts in half the time. -P keeps
    # this folder's names (steps, pages) from hiding others.
    command = [sys.executable, "-P", str(Path(__file__).with_name("mesh_view.py")), str(folder)]
    try:
        child = subprocess.run(command, capture_output=True, text=True, timeout=seconds, check=False)
    except subprocess.TimeoutExpired:
        return f"no picture after {seconds:.0f} s"
    if child.returncode < 0:
        return (
            f"VTK died of signal {-child.returncode}; is an OpenGL library (libegl1 or libosmesa6) installed?"
        )
    lines = child.stderr.strip().splitlines()
    return lines[-1] if child.returncode and lines else ""
