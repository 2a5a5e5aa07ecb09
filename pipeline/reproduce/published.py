"""Tables I and II of the paper, as printed."""

from __future__ import annotations

from dataclasses import dataclass

from flexroad.pipeline.report.content import FIGURES

GEROD, DSC3D = "GeRoD", "DSC3D"
"""The paper's datasets: airborne laser scans of Geobasis NRW (GeRoD) and photogrammetry (DSC3D)."""


@dataclass(frozen=True)
class Row:
    """One row of a table."""

    label: str
    """The row's name in the paper, as plain text."""
    variant: str
    """Name of the variant in configs/ablation.yaml."""
    l2_road_m: float
    l2_terrain_m: float
    mad_road_deg: float
    mad_terrain_deg: float
    triangles: int
    """Table I rounds it to thousands."""

    def value(self, figure: str) -> float:
        """Return a figure by its column name in metrics.parquet."""
        if figure not in FIGURES:
            raise KeyError(figure)
        return float(getattr(self, figure))


TABLE_I = (
    Row("Plane", "plane", 2.05, 2.343, 0, 0, 2),
    Row("RGT", "rgt", 0.415, 1.773, 15.55, 22.191, 124_000),
    Row("FlexRoad", "flexroad", 0.483, 0.332, 1.01, 3.019, 33_000),
)
"""The main comparison, on GeRoD."""

TABLE_I_DSC3D = (
    Row("Plane", "plane", 1.163, 2.727, 0, 0, 2),
    Row("RGT", "rgt", 0.195, 15.411, 7.185, 15.78, 45_000),
    Row("FlexRoad", "flexroad", 0.106, 0.524, 0.43, 1.927, 40_000),
)
"""The main comparison, on DSC3D."""

TABLE_II = (
    Row("Full Pipeline", "flexroad", 0.483, 0.332, 1.01, 3.019, 33_447),
    Row("w/o ECSRC", "wo_ecsrc", 1.021, 1.03, 2.377, 5.528, 33_447),
    Row("w/o DTM Support", "wo_dtm", 0.584, 2.941, 1.081, 3.635, 33_447),
    Row("w/o Dynamic Sampling", "wo_dynamic", 0.615, 1.48, 0.573, 0.619, 122_434),
    Row("w/o NURBS", "wo_nurbs", 0.472, 0.207, 16.23, 5.7, 123_953),
    Row("θz = 0.1 m", "theta_z_0_1", 0.463, 0.274, 0.817, 2.548, 33_444),
    Row("θz = 1.0 m", "theta_z_1", 0.489, 0.331, 1.006, 2.943, 33_447),
    Row("θz = 2.5 m", "theta_z_2_5", 0.516, 0.367, 1.096, 3.101, 33_447),
    Row("θz = 5.0 m", "theta_z_5", 0.526, 0.376, 1.118, 3.129, 33_447),
    Row("θz = 10.0 m", "theta_z_10", 0.549, 0.381, 1.142, 3.142, 33_447),
    Row("Degree: p = q = 2", "degree_2", 0.395, 0.317, 1.118, 3.382, 33_459),
    Row("Degree: p = q = 5", "degree_5", 0.484, 0.351, 0.943, 2.585, 33_434),
    Row("Degree: p = q = 10", "degree_10", 0.491, 0.449, 0.853, 2.251, 33_406),
    Row("Grid: 15 × 15", "grid_15", 0.553, 0.616, 0.635, 2.114, 33_504),
    Row("Grid: 25 × 25", "grid_25", 0.502, 0.411, 0.79, 2.558, 33_614),
    Row("Grid: 45 × 45", "grid_45", 0.474, 0.301, 1.302, 3.571, 33_591),
    Row("Grid: 55 × 55", "grid_55", 0.392, 0.282, 1.568, 3.964, 33_461),
    Row("Sampling: 0.5 m / 5 m", "sampling_0_5", 0.483, 0.326, 0.512, 1.521, 134_113),
    Row("Sampling: 2 m / 20 m", "sampling_2", 0.482, 0.393, 1.985, 5.145, 8_228),
)
"""The ablation study, on GeRoD; the first row is the full pipeline."""

BASE = TABLE_II[0].variant
"""The variant that the ablation's changes are relative to."""


def published(variant: str, dataset: str = GEROD) -> Row | None:
    """Return a variant's row, from Table II if it is in both tables; None if it is in neither."""
    rows = TABLE_I_DSC3D if dataset == DSC3D else (*TABLE_II, *TABLE_I)
    return next((row for row in rows if row.variant == variant), None)
