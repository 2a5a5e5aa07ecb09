"""The data of the map: outline, state, flags and figures of every tile, as columns."""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from flexroad.catalog import Tile
from flexroad.catalog.lazy import lazy
from flexroad.catalog.text import printable
from flexroad.pipeline.store.records import needs_look
from flexroad.pipeline.store.tables import LABELS
from flexroad.tasks.quality.assess import FLAGS, NO_ROAD, STRUCTURE_FLAGS
from flexroad.tools.report.content import Content

pyproj = lazy("pyproj")

DIGITS = 4
"""Significant digits of the figures on the page."""
MAX_ERROR = 400
"""Longest text of an error on the page."""

STATES = {
    "fine": "done, no flag",
    "flagged": "done, flagged",
    "no-road": "done, no road",
    "failed": "failed",
    "pending": "pending",
}
"""State of a tile on the map -> its name in the legend."""

NAMES = ("stratum", "method")
"""Columns with names."""


@dataclass(frozen=True, eq=False)
class TileTable:
    """The tiles of a run with their figures, in the order of the catalog."""

    tiles: tuple[Tile, ...]
    bounds: NDArray[np.float64]
    """West, south, east, north in ``crs``, ``(n, 4)``, m; NaN where the position is not known."""
    crs: str
    """The CRS of most tiles."""
    frame: pd.DataFrame
    """Figures of the first exported variant by tile id, NaN where a tile is not done."""
    states: tuple[str, ...]
    """The state of each tile, a key of `STATES`."""

    @property
    def finished(self) -> list[Tile]:
        """The done tiles."""
        pairs = zip(self.tiles, self.states, strict=True)
        return [tile for tile, state in pairs if state not in ("failed", "pending")]

    @property
    def counts(self) -> Counter[str]:
        """Number of tiles in each state."""
        return Counter(self.states)


def tile_table(tiles: Sequence[Tile], content: Content) -> TileTable:
    """Return the tiles of a run with their figures."""
    known = Counter(tile.grid.crs for tile in tiles if not tile.fault)
    crs = known.most_common(1)[0][0] if known else ""
    of_variant = content.rows.variant == content.variant
    last = of_variant & ~content.rows.tile_id.where(of_variant).duplicated(keep="last")
    frame = content.rows[last].set_index("tile_id").reindex([tile.id for tile in tiles])
    done = np.array([content.states.get(tile.id) in ("done", "cached") for tile in tiles], bool)
    frame.loc[~done, [*LABELS, "flags"]] = np.nan
    states = [
        _state(content.states.get(tile.id, "pending"), flags)
        for tile, flags in zip(tiles, frame["flags"], strict=True)
    ]
    return TileTable(tuple(tiles), _bounds(tiles, crs), crs, frame, tuple(states))


def _state(state: str, flags: Any) -> str:
    if state in ("failed", "pending"):
        return state
    return "flagged" if needs_look(flags) else "no-road" if flags == NO_ROAD else "fine"


def _bounds(tiles: Sequence[Tile], crs: str) -> NDArray[np.float64]:
    # Making a transformer takes as long as a thousand uses.
    transformer = cache(lambda other: pyproj.Transformer.from_crs(other, crs, always_xy=True))
    bounds = np.full((len(tiles), 4), np.nan)
    for i, tile in enumerate(tiles):
        if tile.fault:
            continue
        bounds[i] = tile.grid.bounds
        if tile.grid.crs != crs:
            try:
                bounds[i] = transformer(tile.grid.crs).transform_bounds(*tile.grid.bounds)
            except pyproj.exceptions.ProjError:
                bounds[i] = np.nan
    bounds[~np.isfinite(bounds).all(axis=1)] = np.nan
    return bounds


def numeric_columns(table: TileTable) -> dict[str, tuple[str, str, pd.Series]]:
    """Return label, unit and values of each numeric column that has a value; shares in percent."""
    columns = {}
    for name, (label, unit) in LABELS.items():
        values = pd.to_numeric(table.frame[name], errors="coerce").astype("float64")
        if np.isfinite(values).any():
            columns[name] = (label, unit, values * 100 if unit == "%" else values)
    return columns


def map_data(
    table: TileTable, failed: Mapping[str, str], more: Mapping[str, tuple[str, str, pd.Series]]
) -> dict[str, Any]:
    """Return the tiles for the page's script, to be written by `as_script`.

    - `failed`: the error of each failed tile by id.
    - `more`: further columns in the form of `numeric_columns`: differences.
    """
    finite = table.bounds[np.isfinite(table.bounds[:, 0])]
    west, south, east, north = (*finite[:, :2].min(0), *finite[:, 2:].max(0)) if len(finite) else (0.0,) * 4
    raised = {name for flags in table.frame["flags"].dropna() for name in flags.split(", ")}
    flag_names = [*FLAGS, NO_ROAD, *(name for name in STRUCTURE_FLAGS if name in raised)]
    columns: list[dict[str, Any]] = [
        {
            "key": key,
            "label": label,
            "unit": unit,
            "values": values.to_numpy(),
            # A difference of zero always has the neutral colour.
            "signed": key in more,
        }
        for key, (label, unit, values) in (numeric_columns(table) | dict(more)).items()
    ]
    for name in NAMES:
        values = table.frame[name].fillna("").astype(str)
        if values[values != ""].nunique() > 1:
            columns.append({"key": name, "label": name, "names": [printable(value) for value in values]})
    return {
        "crs": table.crs,
        "bounds": [west, south, east, north],
        "ids": [printable(tile.id) for tile in table.tiles],
        "boxes": table.bounds - [west, south] * 2,
        "stateNames": STATES,
        "states": [list(STATES).index(state) for state in table.states],
        "flagNames": flag_names,
        "flags": [_bits(flags, flag_names) for flags in table.frame["flags"]],
        "columns": columns,
        "errors": {
            str(i): printable(failed[tile.id])[:MAX_ERROR]
            for i, tile in enumerate(table.tiles)
            if tile.id in failed
        },
    }


def errors(content: Content) -> dict[str, str]:
    """Return the error of each failed tile by id: from the summary, else from its row."""
    by_row = content.rows[content.rows.status == "failed"].drop_duplicates("tile_id")
    found = dict(zip(by_row.tile_id, by_row.error.fillna("").astype(str), strict=True))
    for failure in reversed(content.counts.failures):
        found[failure.tile_id] = f"{failure.line}{f'  [{failure.file}]' if failure.file else ''}"
    return {tile_id: text for tile_id, text in found.items() if content.states.get(tile_id) == "failed"}


def as_script(data: Any) -> str:
    """Return data as JSON that is safe inside of ``<script>``: no character can begin a tag.

    Arrays of figures, ``(n,)``, have `DIGITS` digits; arrays of boxes, ``(n, 4)``, are in centimetres.
    """
    # One array at a time: as objects, the numbers of all tiles take gigabytes.
    text = json.dumps(data, ensure_ascii=True, allow_nan=False, separators=(",", ":"), default=_listed)
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def short(value: float) -> str:
    """Return a number with three digits, or as a whole number."""
    return f"{value:,.0f}" if abs(value) >= 100 else f"{value:.3g}"


def _listed(values: NDArray[np.float64]) -> list[Any]:
    """Return an array as `as_script` writes it; NaN becomes null."""
    if values.ndim == 1:
        return [_rounded(value) for value in values.tolist()]
    return [None if math.isnan(row[0]) else [round(edge, 2) for edge in row] for row in values.tolist()]


def _rounded(value: float) -> float | int | None:
    if not math.isfinite(value):
        return None
    rounded = float(f"{value:.{DIGITS}g}")
    return int(rounded) if rounded.is_integer() else rounded


def _bits(flags: Any, names: Sequence[str]) -> int:
    given = set(flags.split(", ")) if isinstance(flags, str) and flags else set()
    return sum(1 << i for i, name in enumerate(names) if name in given)
