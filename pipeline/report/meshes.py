"""The result of the check of every mesh (`tasks.metrics.mesh_check`), which the stage `evaluate` makes."""

from __future__ import annotations

from collections.abc import Iterable

import pandas as pd

from flexroad.tasks.errors import MeshFault

COLUMNS = ["method", "meshes", "faces", "meshes with faults", "result"]
MEANING = (
    "A mesh has no fault if all numbers are finite, all faces have an area and look up, no faces overlap in "
    "plan, edges meet at vertices only, and no vertex is unused or there twice. A tile that has a mesh with "
    "faults is failed; the faces are those of the other meshes."
)
FAULT = f"evaluate: {MeshFault.__name__}: "
"""Start of the error of a row whose mesh has a fault."""


def mesh_checks(rows: pd.DataFrame, variants: Iterable[str]) -> pd.DataFrame:
    """Return one row per variant that has meshes, columns `COLUMNS`, from the rows of a run."""
    table = []
    for variant in variants:
        own = rows[rows.variant == variant]
        faces = own.triangles[own.status == "done"]
        faulty = int(own.error.fillna("").str.startswith(FAULT).sum())
        if meshes := len(faces) + faulty:
            result = f"error: {faulty} of {meshes} meshes have faults" if faulty else "no fault"
            table.append((variant, meshes, int(faces.sum()), faulty, result))
    return pd.DataFrame(table, columns=COLUMNS)
