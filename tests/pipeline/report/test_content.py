"""The report's row on the check of the meshes."""

import pandas as pd
import pytest

from flexroad.pipeline.report.content import MESH_COLUMNS, mesh_checks
from flexroad.pipeline.store.tables import metrics_frame

FAULT = "evaluate: MeshFault: the mesh has 2 inverted faces (the first at 1.000, 2.000)"


def row(variant, triangles=None, error=""):
    status = "failed" if error else "done"
    return {"tile_id": "t", "variant": variant, "status": status, "triangles": triangles, "error": error}


@pytest.mark.parametrize(
    ("rows", "expected"),
    [
        (
            [row("a", 10), row("a", 20), row("b", 5)],
            [("a", 2, 30, 0, "no fault"), ("b", 1, 5, 0, "no fault")],
        ),
        ([row("a", 10), row("a", error=FAULT)], [("a", 2, 10, 1, "error: 1 of 2 meshes have faults")]),
        ([row("a", error=FAULT)], [("a", 1, 0, 1, "error: 1 of 1 meshes have faults")]),
        ([row("a", error="load: TaskError: no MeshFault: x")], []),
    ],
)
def test_mesh_checks_count_meshes_faces_and_faults(rows, expected):
    pd.testing.assert_frame_equal(
        mesh_checks(metrics_frame(rows), ["a", "b", "c"]),
        pd.DataFrame(expected, columns=MESH_COLUMNS),
        check_dtype=False,
    )
