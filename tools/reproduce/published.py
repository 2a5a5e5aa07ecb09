"""The paper's Tables I and II, as printed, and the claims of its text about them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from flexroad.tools.report.content import FIGURES

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


def published(variant: str, dataset: str = GEROD) -> Row:
    """Return a variant's row, from Table II if it is in both tables."""
    rows = TABLE_I_DSC3D if dataset == DSC3D else (*TABLE_II, *TABLE_I)
    return next(row for row in rows if row.variant == variant)


class Claim(NamedTuple):
    """A claim of the text: variants are in ascending order of a figure, or the second changes it."""

    text: str
    where: str
    """Section of the paper that makes the claim."""
    figure: str
    variants: tuple[str, ...]
    """Variants in ascending order; or two variants: the second is compared with the first."""
    quoted: float | None = None
    """Change in percent, as quoted in the paper's text; None if the claim is about the order."""
    slack: float = 0.0
    """Relative amount by which a value may exceed the next (for claims such as "without loss")."""
    dataset: str = GEROD


RESULTS, ABLATION, CONCLUSION = "Comparative Analysis", "Ablation Study", "Conclusion"
ROAD, TERRAIN, MAD_ROAD, MAD_TERRAIN, T = FIGURES

CLAIMS = (
    Claim("RGT is the most accurate on roads, a plane the least", RESULTS, ROAD, ("rgt", BASE, "plane")),
    Claim(
        "FlexRoad is the most accurate on terrain, a plane the least",
        RESULTS,
        TERRAIN,
        (BASE, "rgt", "plane"),
    ),
    Claim("A plane is the smoothest road, RGT the roughest", RESULTS, MAD_ROAD, ("plane", BASE, "rgt")),
    Claim("A plane is the smoothest terrain, RGT the roughest", RESULTS, MAD_TERRAIN, ("plane", BASE, "rgt")),
    Claim("A plane has the fewest triangles, RGT the most", RESULTS, T, ("plane", BASE, "rgt")),
    Claim("On terrain, L2 is 81% below RGT's", RESULTS, TERRAIN, ("rgt", BASE), -81),
    Claim("Terrain MAD falls from RGT's 22.191° to 3.019°", RESULTS, MAD_TERRAIN, ("rgt", BASE), -86),
    Claim("Road L2 is only 16% above RGT's", RESULTS, ROAD, ("rgt", BASE), 16),
    Claim("Road MAD is 93% below RGT's", RESULTS, MAD_ROAD, ("rgt", BASE), -93),
    Claim("Triangles are 73% fewer than RGT's", RESULTS, T, ("rgt", BASE), -73),
    Claim("Road L2 is 76% below a plane's", CONCLUSION, ROAD, ("plane", BASE), -76),
    Claim(
        "DSC3D: FlexRoad is the most accurate on roads", RESULTS, ROAD, (BASE, "rgt", "plane"), dataset=DSC3D
    ),
    Claim(
        "DSC3D: FlexRoad is the most accurate on terrain",
        RESULTS,
        TERRAIN,
        (BASE, "plane", "rgt"),
        dataset=DSC3D,
    ),
    Claim("DSC3D: roads are 94% smoother than RGT's", RESULTS, MAD_ROAD, ("rgt", BASE), -94, dataset=DSC3D),
    Claim(
        "DSC3D: triangles are 11% fewer than RGT's (40K, 45K)", RESULTS, T, ("rgt", BASE), -11, dataset=DSC3D
    ),
    Claim("w/o ECSRC, road L2 rises by 111%", ABLATION, ROAD, (BASE, "wo_ecsrc"), 111),
    Claim("w/o ECSRC, road MAD rises by 135%", ABLATION, MAD_ROAD, (BASE, "wo_ecsrc"), 135),
    Claim("w/o DTM support, terrain L2 rises by 786%", ABLATION, TERRAIN, (BASE, "wo_dtm"), 786),
    Claim("w/o NURBS, road MAD rises by 1507%", ABLATION, MAD_ROAD, (BASE, "wo_nurbs"), 1507),
    Claim("w/o NURBS, triangles rise by 271%", ABLATION, T, (BASE, "wo_nurbs"), 271),
    Claim("Dynamic sampling removes 73% of the triangles", ABLATION, T, ("wo_dynamic", BASE), -73),
    Claim(
        "Dynamic sampling keeps the road's accuracy (within 5%)",
        ABLATION,
        ROAD,
        (BASE, "wo_dynamic"),
        slack=0.05,
    ),
    Claim(
        "Dynamic sampling keeps the terrain's accuracy (within 5%)",
        ABLATION,
        TERRAIN,
        (BASE, "wo_dynamic"),
        slack=0.05,
    ),
    Claim("θz = 0.1 m lowers road L2 by 4%", ABLATION, ROAD, (BASE, "theta_z_0_1"), -4),
    Claim("θz = 0.1 m lowers road MAD by 19%", ABLATION, MAD_ROAD, (BASE, "theta_z_0_1"), -19),
    Claim("Degree 2 lowers road L2 by 18%", ABLATION, ROAD, (BASE, "degree_2"), -18),
    Claim("Degree 2 is rougher on roads than 3", ABLATION, MAD_ROAD, (BASE, "degree_2")),
    Claim(
        "Higher degrees are less accurate on roads than 3", ABLATION, ROAD, (BASE, "degree_5", "degree_10")
    ),
    Claim("Higher degrees are smoother on roads than 3", ABLATION, MAD_ROAD, ("degree_10", "degree_5", BASE)),
    Claim("55 × 55 points lower road L2 by 19%", ABLATION, ROAD, (BASE, "grid_55"), -19),
    Claim("55 × 55 points raise road MAD by 55%", ABLATION, MAD_ROAD, (BASE, "grid_55"), 55),
    Claim(
        "More control points are more accurate on roads",
        ABLATION,
        ROAD,
        ("grid_55", "grid_45", BASE, "grid_25", "grid_15"),
    ),
    Claim(
        "More control points are rougher on roads: the trade-off",
        ABLATION,
        MAD_ROAD,
        ("grid_15", "grid_25", BASE, "grid_45", "grid_55"),
    ),
    Claim("Sampling at 0.5 m / 5 m lowers road MAD by 49%", ABLATION, MAD_ROAD, (BASE, "sampling_0_5"), -49),
    Claim(
        "Sampling at 0.5 m / 5 m doubles the triangles (four times in Table II)",
        ABLATION,
        T,
        (BASE, "sampling_0_5"),
        100,
    ),
    Claim("Sampling at 2 m / 20 m removes 75% of the triangles", ABLATION, T, (BASE, "sampling_2"), -75),
    Claim("Sampling at 2 m / 20 m doubles the road's MAD", ABLATION, MAD_ROAD, (BASE, "sampling_2"), 100),
    Claim("ECSRC contributes: road L2", CONCLUSION, ROAD, (BASE, "wo_ecsrc")),
    Claim("DTM support contributes: terrain L2", CONCLUSION, TERRAIN, (BASE, "wo_dtm")),
    Claim("NURBS contributes: road MAD", CONCLUSION, MAD_ROAD, (BASE, "wo_nurbs")),
)
