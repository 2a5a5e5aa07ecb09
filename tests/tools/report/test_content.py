"""The report's row on the check of the meshes."""

import pandas as pd
import pytest

from flexroad.pipeline.store.tables import metrics_frame
from flexroad.tools.report.content import MESH_COLUMNS, decks_and_tunnels, mesh_checks

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


def test_table_of_decks_has_flagged_ones_first():
    figures = {
        "area_m2": 160.0,
        "abutments": 2,
        "clearance_m": 6.5,
        "error_estimate_m": None,
        "measured_road": 0.9,
    }
    rows = [
        {"tile_id": name, "variant": variant, "level": level, **figures, "flags": flags}
        for name, variant, level, flags in [("t", "a", 1, ""), ("t", "b", 1, ""), ("u", "a", -1, "no-rise")]
    ]
    table = decks_and_tunnels(rows, "a")
    assert table.columns[:5].tolist() == ["tile", "level", "area (m²)", "abutments", "clearance (m)"]
    assert table.columns[5:].tolist() == ["error estimate (m)", "measured (%)", "flags"]
    assert table[["tile", "level", "flags"]].to_numpy().tolist() == [["u", -1, "no-rise"], ["t", 1, "–"]]
    assert table["measured (%)"].tolist() == [90, 90]
    assert decks_and_tunnels(rows, "c").empty
