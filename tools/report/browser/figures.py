"""Quality of the tiles: histograms of the main figures as SVG, and a comparison with another run."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import pandas as pd
from markupsafe import Markup

from flexroad.catalog.text import count
from flexroad.pipeline.store.tables import LABELS
from flexroad.tools.report.browser.tiles import TileTable, short

FIGURES = ("error_estimate_m", "l2_road_m", "l2_terrain_m", "mad_road_deg", "triangles", "seconds")
"""Figures that are compared; for all of them smaller is better."""
NONE = "–"
NOISE = ("seconds",)
"""Figures that differ each time, so that they are neither better nor worse."""
SAME = 1e-6
"""Relative difference up to which figures are taken as equal: processors differ in rounding."""
SHOWN = ("error_estimate_m", "l2_road_m", "mad_road_deg", "measured_road", "seconds")
"""Columns with a histogram, if they have values; at most `MOST` are shown."""
MOST = 4
BARS = 24
WIDTH, HEIGHT, BELOW, ABOVE = 300, 96, 22, 12
"""Size of a chart without its labels, and the space for labels below and above (px)."""
BAR = Markup('<rect class="{}" x="{:.1f}" y="{:.1f}" width="{:.1f}" height="{:.1f}"><title>{}</title></rect>')
FEW = 3
"""Least number of values of a histogram."""


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
        """The change as a column of the map: label, unit and values by name; empty without values."""
        label = ("change of the error estimate", "m", self.change)
        return {"change_m": label} if np.isfinite(self.change).any() else {}


def compare(table: TileTable, before: pd.DataFrame, variant: str, name: str) -> Comparison:
    """Compare the tiles of a run with the rows of another run.

    - `before`: the other run's metrics.parquet.
    - `name`: name of the other run in the text.
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
                "before": short(then.mean()),
                "now": short(now.mean()),
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


def histograms(
    columns: dict[str, tuple[str, str, pd.Series]], limits: dict[str, float]
) -> Iterator[tuple[str, Markup, str]]:
    """Yield title, chart and description of the main columns (label, unit, values).

    - `limits`: the flags' thresholds.
    """
    shown = 0
    for name in SHOWN:
        if name not in columns or shown == MOST:
            continue
        label, unit, series = columns[name]
        values = series.to_numpy()
        values = values[np.isfinite(values)]
        if len(values) < FEW:
            continue
        shown += 1
        median, high = np.percentile(values, [50, 95])
        yield (
            f"{label} ({unit})" if unit else label,
            _svg(values, limits.get(name), label),
            f"median {short(median)}, 95% below {short(high)}; {count(len(values), 'tile')}",
        )


def _svg(values: np.ndarray, limit: float | None, label: str) -> Markup:
    low, high = _range(values, limit)
    # Values beyond the range are in the last bar.
    heights, edges = np.histogram(np.clip(values, low, high), BARS, (low, high))
    scale, width = HEIGHT / max(1, heights.max()), WIDTH / BARS
    bars = Markup("").join(
        BAR.format(
            "over" if limit is not None and edges[i] >= limit * (1 - 1e-9) else "bar",
            i * width + 0.5,
            ABOVE + HEIGHT - (tall := max(float(n) * scale, 1.5 if n else 0.0)),
            width - 1,
            tall,
            f"{short(edges[i])} to {short(edges[i + 1])}: {count(int(n), 'tile')}",
        )
        for i, n in enumerate(heights)
    )  # fmt: skip
    more = "≥ " if values.max() > high * (1 + 1e-9) else ""
    axis = Markup('<text x="0" y="{0}">{1}</text><text x="{2}" y="{0}" text-anchor="end">{3}</text>').format(
        ABOVE + HEIGHT + 16, short(low), WIDTH, more + short(high)
    )
    return Markup(
        '<svg viewBox="-1 0 {} {}" role="img" aria-label="{}">{}{}<path class="axis" d="M0 {y}H{}"/>{}</svg>'
    ).format(
        WIDTH + 2,
        ABOVE + HEIGHT + BELOW,
        f"Histogram of tiles by {label}",
        bars,
        _mark(limit, low, high),
        WIDTH,
        axis,
        y=ABOVE + HEIGHT,
    )


def _mark(limit: float | None, low: float, high: float) -> Markup:
    """Return a line at the threshold of a flag."""
    if limit is None or not low < limit < high:
        return Markup("")
    x = WIDTH * (limit - low) / (high - low)
    return Markup(
        '<path class="limit" d="M{x:.1f} {}V{}"/>'
        '<text class="limit" x="{x2:.1f}" y="{}"{}>flag above {}</text>'
    ).format(
        ABOVE - 4,
        ABOVE + HEIGHT,
        ABOVE + 4,
        Markup(' text-anchor="end"') if x > WIDTH / 2 else "",
        short(limit),
        x=x,
        x2=x + (-5 if x > WIDTH / 2 else 5),
    )


def _range(values: np.ndarray, limit: float | None) -> tuple[float, float]:
    """Return a range with round ends that single high values do not extend."""
    high = float(np.percentile(values, 98))
    if limit is not None and values.max() > limit:
        high = max(high, 1.5 * limit)
    low = float(values.min())
    # From zero, unless all values are far from it.
    low = 0.0 if 0 <= low < 0.6 * high else low
    step = 10.0 ** math.floor(math.log10(max(high - low, 1e-6))) / 2
    low, high = math.floor(low / step) * step, math.ceil(high / step + 1e-9) * step
    return low, max(high, low + step)
