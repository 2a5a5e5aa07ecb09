"""Which tiles to look at first, where there is no ground truth: by what surfaces tell of themselves."""

from __future__ import annotations

import pandas as pd

FIGURES = {
    "error_estimate_m": "doubt (m)",
    "suspect_m2": "largest doubted patch (m²)",
    "residual_p95_m": "p95 to own points (m)",
    "curvature_per_m": "curvature (1/m)",
    "edge_step_m": "edge step (m)",
    "off_dtm_road": "off the DTM (%)",
    "dropped_road": "dropped (%)",
    "bounded_weights": "weights at bounds (%)",
}
SUPPORT = {"measured_road": "measured (%)", "dtm_road": "DTM (%)", "inferred_road": "inferred (%)"}
"""What the surface rests on, in shares of the road."""
MEANING = (
    "The doubt is the mean distance of the surface, over the cells of the raw road mask, to the nearer of "
    "two witnesses: the scan, where the filter kept it and no better than it scatters there, and the DTM. "
    "In metres, it guesses at the road L2; what both witnesses are wrong about it does not know. Flags are "
    "raised by the thresholds of `assess`; docs/quality.md explains each."
)


def over_tiles(done: pd.DataFrame, variants: list[str]) -> pd.DataFrame:
    """Return the figures of each variant, mean over tiles, and how many tiles have a flag."""
    if not done["error_estimate_m"].notna().any():
        return pd.DataFrame()
    table = done.groupby("variant")[[*FIGURES, *SUPPORT]].mean().reindex(variants)
    flagged = (done["flags"].fillna("") != "").groupby(done.variant).sum()
    table = _printed(table)
    table.insert(0, "flagged tiles", flagged.reindex(variants))
    return table.reset_index().rename(columns={"variant": "method"})


def most_doubtful(done: pd.DataFrame, variant: str, most: int) -> pd.DataFrame:
    """Return the tiles of a variant with the greatest doubt, the worst first, and their flags."""
    table = done[(done.variant == variant) & done["error_estimate_m"].notna()].nlargest(
        most, "error_estimate_m"
    )
    shown = _printed(table[[*FIGURES, *SUPPORT]])
    shown.insert(0, "tile", table.tile_id)
    return shown.assign(flags=table["flags"].replace("", "–"))


def _printed(table: pd.DataFrame) -> pd.DataFrame:
    names = FIGURES | SUPPORT
    shares = [name for name in names if "%" in names[name]]
    return table.assign(**{name: 100 * table[name] for name in shares}).rename(columns=names)
