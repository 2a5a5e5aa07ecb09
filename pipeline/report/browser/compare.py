"""Comparison of a run with another one over the same tiles, such as the run before."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd

from flexroad.catalog.text import count
from flexroad.pipeline.report.browser.tiles import LABELS, TileTable

FIGURES = ("error_estimate_m", "l2_road_m", "l2_terrain_m", "mad_road_deg", "triangles", "seconds")
"""Figures that are compared; smaller is better for all of them."""
NONE = "–"
NOISE = ("seconds",)
"""Figures that differ each time: neither better nor worse."""
SAME = 1e-6
"""Relative difference up to which a figure counts as the same: other processors round otherwise."""


@dataclass(frozen=True, eq=False)
class Comparison:
    """Figures of the tiles that are done in both runs."""

    line: str
    table: pd.DataFrame
    """One row per figure: means in both runs, difference, and the number of better and worse tiles."""
    worse: pd.DataFrame
    """Tiles whose error estimate grew most."""
    change: pd.Series
    """Error estimate now minus before (m) by tile; NaN where one of them is missing."""

    @property
    def columns(self) -> dict[str, tuple[str, str, pd.Series]]:
        """The change as a column of the map: label, unit and values by name; empty if no tile has it."""
        label = ("change of the error estimate", "m", self.change)
        return {"change_m": label} if np.isfinite(self.change).any() else {}


def compare(table: TileTable, before: pd.DataFrame, variant: str, name: str) -> Comparison:
    """Compare the tiles of a run with the rows of another one, called ``name``.

    Parameters
    ----------
    table : TileTable
        The tiles of this run.
    before : DataFrame
        The other run's metrics.parquet.
    variant : str
        The variant that is compared.
    name : str
        Name of the other run in the text.
    """
    own = before[(before.variant == variant) & (before.status == "done")].drop_duplicates("tile_id")
    old = own.set_index("tile_id").reindex(table.frame.index)
    rows = []
    for figure in FIGURES:
        now, then = (pd.to_numeric(f[figure], errors="coerce").astype("float64") for f in (table.frame, old))
        both = np.isfinite(now) & np.isfinite(then)
        if not both.any():
            continue
        now, then = now[both], then[both]
        same = np.isclose(now, then, rtol=SAME, atol=0)
        label, unit = LABELS[figure]
        rows.append(
            {
                "figure, mean over tiles": f"{label} ({unit})" if unit else label,
                "before": _number(then.mean()),
                "now": _number(now.mean()),
                "change": "0" if same.all() else f"{now.mean() - then.mean():+.3g}",
                "better": NONE if figure in NOISE else int((~same & (now < then)).sum()),
                "same": NONE if figure in NOISE else int(same.sum()),
                "worse": NONE if figure in NOISE else int((~same & (now > then)).sum()),
            }
        )
    change = (table.frame.error_estimate_m - old.error_estimate_m).astype("float64")
    worst = change[change > 0].nlargest(5)
    worse = pd.DataFrame(
        {
            "tile": worst.index,
            "error estimate before (m)": old.error_estimate_m[worst.index].to_numpy(),
            "now (m)": table.frame.error_estimate_m[worst.index].to_numpy(),
            "flags now": table.frame["flags"][worst.index].replace("", "–").to_numpy(),
        }
    )
    return Comparison(_line(table, own, name), pd.DataFrame(rows), worse, change)


def _number(value: float) -> str:
    return f"{value:,.0f}" if abs(value) >= 100 else f"{value:.3g}"


def _line(table: TileTable, before: pd.DataFrame, name: str) -> str:
    then = set(before.tile_id)
    now = {tile.id for tile in table.finished}
    if not now & then:
        return f"Nothing can be compared with {name}: no tile is done in both."
    parts = [f"{count(len(now & then), 'tile')} done in both runs"]
    if more := len(now - then):
        parts.append(f"{more} done only now")
    if less := len(then - now):
        parts.append(f"{less} done only before")
    return f"Compared with {name}: {', '.join(parts)}."
