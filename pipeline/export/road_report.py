"""The report of roads along lines: a table with the errors of each, and a summary."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping
from typing import Any

import numpy as np

from flexroad.catalog.storage.paths import Location, read, stat, write
from flexroad.catalog.text import count, no_formula
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.export.network import Network
from flexroad.pipeline.export.pieces import Row
from flexroad.tasks.roads.height_grid import HeightAt, HeightGrid, grid_error
from flexroad.tasks.roads.profiles import Profiles, profile_error

REPORT = "roads.csv"
NO_ROAD = "no road lies on the tiles"
SHOWN_M = 10.0
"""Length of centre lines left out from which the user is told (m); the ends of routes are always a bit."""


def row(road: int, grid: HeightGrid, height: HeightAt, fitted: Profiles) -> Row:
    """Return a road's row of the report."""
    line, own = grid.line, grid_error(grid, height)
    missed = profile_error(grid, fitted)
    half = float(line.width.max()) / 2
    errors = {
        "crg_median_mm": own.median_m,
        "crg_max_mm": own.max_m,
        "profiles_mean_mm": missed.mean_m,
        "profiles_max_mm": missed.max_m,
        "off_centre_line_mm": line.offset_m,
    }
    return {
        "id": road,
        "name": line.name,
        "length_m": round(float(line.s[-1]), 3),
        "width_m": round(2 * half, 3),
        **{key: millimetres(value) for key, value in errors.items()},
        "bounds": [
            float(line.x.min()) - half,
            float(line.y.min()) - half,
            float(line.x.max()) + half,
            float(line.y.max()) + half,
        ],
    }


def millimetres(metres: float) -> float | None:
    """Return a length in mm for JSON; None if it is not known."""
    return round(metres * 1000, 3) if np.isfinite(metres) else None


def report(folder: Location, rows: list[Row], roads: Network) -> dict[str, Any]:
    """Write the report of the roads, if it is new; return the summary for the manifest.

    Raises
    ------
    ConfigError
        If no route has a road.
    """
    every = [road for row in rows for road in row["roads"]]
    if not every:
        raise ConfigError(f"no road could be written: {rows[0]['problem']}, and so on" if rows else NO_ROAD)
    write_new(folder / REPORT, _table([{k: v for k, v in road.items() if k != "bounds"} for road in every]))
    return {
        **totals(rows, roads),
        "crg_max_mm": _largest(every, "crg_max_mm"),
        "profiles_mean_mm": _mean(every, "profiles_mean_mm"),
        "profiles_max_mm": _largest(every, "profiles_max_mm"),
    }


def totals(rows: list[Row], roads: Network) -> dict[str, Any]:
    """Return number and length of the roads, and what was left out of the centre lines on the tiles."""
    length = sum(road["length_m"] for row in rows for road in row["roads"])
    return {
        "roads": sum(len(row["roads"]) for row in rows),
        "length_m": round(length, 1),
        "left_out_m": round(max(0.0, sum(roads.lengths) - length), 1),
        "left_out_areas": roads.areas,
        "notes": list(roads.notes),
    }


def with_line(figures: Mapping[str, Any], error: str = "") -> dict[str, Any]:
    """Return figures with a line for the user, the summary: number and length of the roads, their error."""
    text = f"{count(figures['roads'], 'road')}, {figures['length_m'] / 1000:.2f} km"
    if figures["left_out_m"] >= SHOWN_M:
        text += f", {figures['left_out_m'] / 1000:.2f} km of centre lines left out"
    if figures["left_out_areas"]:
        text += f", {count(figures['left_out_areas'], 'area')} without centre line left out"
    return {**figures, "summary": f"{text}; {error}" if error else text}


def write_new(where: Location, data: bytes) -> None:
    """Write a small file unless it has this content."""
    known = stat(where)
    if known is None or known.size != len(data) or read(where) != data:
        write(where, data)


def _table(rows: list[Row]) -> bytes:
    file = io.StringIO(newline="")
    if rows:
        table = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
        table.writeheader()
        table.writerows({name: no_formula(value) for name, value in row.items()} for row in rows)
    return file.getvalue().encode()


def _known(roads: list[Row], key: str) -> list[Row]:
    return [road for road in roads if road[key] is not None]


def _largest(roads: list[Row], key: str) -> float | None:
    return max((road[key] for road in _known(roads, key)), default=None)


def _mean(roads: list[Row], key: str) -> float | None:
    """Return the mean over the length of the roads."""
    known = _known(roads, key)
    length = sum(road["length_m"] for road in known)
    return round(sum(road[key] * road["length_m"] for road in known) / length, 3) if known else None
