"""Report tables of the stage `assess`: which tiles to inspect first if there is no ground truth."""

from __future__ import annotations

import pandas as pd

from flexroad.tasks.quality.assess import NO_ROAD

FIGURES = {
    "error_estimate_m": "error estimate (m)",
    "suspect_m2": "largest suspect patch (m²)",
    "residual_p95_m": "p95 to its road points (m)",
    "curvature_per_m": "curvature (1/m)",
    "edge_step_m": "edge step (m)",
    "off_dtm_road": "off the DTM (%)",
    "dropped_road": "dropped (%)",
    "bounded_weights": "weights at bounds (%)",
}
SUPPORT = {"measured_road": "measured (%)", "dtm_road": "DTM (%)", "inferred_road": "inferred (%)"}
"""Shares of the road by the support of the surface."""
MEANING = (
    "The error estimate follows from what the surface leaves of the heights that it was fitted to, around "
    "each cell of the raw road mask, and from the scatter of the DSM that the filter kept. It estimates the "
    "road L2; errors common to DSM and DTM are not detected. Flags are set by the thresholds of `assess`; "
    "docs/quality.md explains each flag."
)
HOLDOUT = "A second fit did without these squares of road (`assess.holdout`); 90% intervals hold 90% of them."


def over_tiles(done: pd.DataFrame, variants: list[str]) -> pd.DataFrame:
    """Return the means over tiles and the number of flagged tiles per variant; empty without estimates.

    A tile whose only flag is that it has no road is no problem, and is not counted as flagged.
    """
    if not done["error_estimate_m"].notna().any():
        return pd.DataFrame()
    table = done.groupby("variant")[[*FIGURES, *SUPPORT]].mean().reindex(variants)
    flagged = (~done["flags"].fillna("").isin(["", NO_ROAD])).groupby(done.variant).sum()
    table = _labelled(table)
    table.insert(0, "flagged tiles", flagged.reindex(variants))
    return table.reset_index().rename(columns={"variant": "method"})


def held_out(done: pd.DataFrame, variants: list[str]) -> pd.DataFrame:
    """Return how well a second fit and its intervals meet the squares withheld from it; empty without any."""
    counted = done[done["holdout_squares"].fillna(0) > 0]
    if counted.empty:
        return pd.DataFrame()
    squares = counted["holdout_squares"]
    sums = pd.DataFrame(
        {
            "withheld squares": squares,
            "mean difference (m)": counted["holdout_error_m"] * squares,
            "within the 90% interval (%)": 100 * counted["holdout_covered"] * squares,
        }
    )
    table = sums.groupby(counted["variant"]).sum().reindex(variants).dropna()
    table.iloc[:, 1:] = table.iloc[:, 1:].div(table["withheld squares"], axis=0)
    table["withheld squares"] = table["withheld squares"].astype(int)
    return table.reset_index().rename(columns={"variant": "method"})


def highest_error_estimates(done: pd.DataFrame, variant: str, most: int) -> pd.DataFrame:
    """Return the tiles of a variant with the highest error estimate, highest first, with their flags."""
    table = done[(done.variant == variant) & done["error_estimate_m"].notna()].nlargest(
        most, "error_estimate_m"
    )
    result = _labelled(table[[*FIGURES, *SUPPORT]])
    result.insert(0, "tile", table.tile_id)
    return result.assign(flags=table["flags"].replace("", "–"))


def _labelled(table: pd.DataFrame) -> pd.DataFrame:
    """Rename columns to their labels, and convert shares to percent."""
    names = FIGURES | SUPPORT
    shares = [name for name in names if "%" in names[name]]
    return table.assign(**{name: 100 * table[name] for name in shares}).rename(columns=names)
