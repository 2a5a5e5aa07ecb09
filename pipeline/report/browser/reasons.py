"""The flags of a tile in plain words: what is wrong, where, and what to do."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import pandas as pd

from flexroad.tasks.quality.assess import FLAGS, NO_ROAD, Options
from flexroad.tasks.quality.places import Place


@dataclass(frozen=True)
class Meaning:
    """What a flag says."""

    words: str
    """What is wrong, with ``{value}`` and ``{limit}``."""
    remedy: str
    """What to do, with ``{there}`` where the flag's place belongs."""
    percent: bool = False
    """Whether value and limit are shares, which are shown in percent."""


MEANINGS = {
    "error-estimate": Meaning(
        "the surface is {value} m off on average, by what it leaves of DSM and DTM (limit {limit} m)",
        "compare DSM and DTM{there}: one of them is wrong or older",
    ),
    "patch": Meaning(
        "{value} m² of road in one piece are far from both DSM and DTM (limit {limit} m²)",
        "look for a bridge, a tree or a gap in the data{there}",
    ),
    "spike": Meaning(
        "the surface bends more than a road can ({value} 1/m, limit {limit} 1/m)",
        "look at the mask{there}: it may reach over a wall, a roof or a bank",
    ),
    "edge-step": Meaning(
        "the surface steps by {value} m at the road's edge (limit {limit} m)",
        "look at the mask{there}: it may be wider than the road, or shifted",
    ),
    "loose": Meaning(
        "5% of the kept road points are more than {value} m from the surface (limit {limit} m)",
        "look for cars, trees or a second level{there} that the filter kept",
    ),
    "off-dtm": Meaning(
        "{value} of the road lie off the DTM (limit {limit})",
        "a bridge is right; otherwise the DTM is wrong or older{there}",
        percent=True,
    ),
    "inferred": Meaning(
        "{value} of the road have no height in the data (limit {limit})",
        "fill the gap in the data{there}, or take the road out of the mask",
        percent=True,
    ),
    "dropped": Meaning(
        "the filter dropped {value} of the road mask (limit {limit})",
        "look whether there is a road{there} at all, or trees above it",
        percent=True,
    ),
    "weights": Meaning(
        "{value} of the NURBS weights are at their limit (limit {limit})",
        "use fit.weights: unit",
        percent=True,
    ),
    NO_ROAD: Meaning(
        "no road was found on the tile, so its surface is the terrain",
        "if there is a road, check the road source of the catalog and the options of segment and ecsrc",
    ),
}
"""Meaning of each flag."""


@dataclass(frozen=True)
class Reason:
    """One flag of one tile in words."""

    flag: str
    words: str
    """What is wrong, with the value and the limit."""
    place: Place | None
    """Where to look (easting, northing, m); None if it concerns the complete tile or is not known."""
    remedy: str

    @property
    def line(self) -> str:
        """All in one line."""
        at = f", at {coordinates(*self.place)}" if self.place else ""
        return f"{self.flag}: {self.words}{at}; {self.remedy}"


def reasons(row: Mapping[str, Any], options: Options, places: Mapping[str, Place]) -> list[Reason]:
    """Return a tile's flags in words.

    Parameters
    ----------
    row : Mapping
        The tile's row of metrics.parquet.
    options : Options
        The thresholds of the flags.
    places : Mapping
        Place of each flag, as far as known (`flexroad.tasks.quality.places.places`).
    """
    given = row.get("flags")
    names = given.split(", ") if isinstance(given, str) and given else []
    return [_reason(name, row, options, places) for name in names]


def _reason(name: str, row: Mapping[str, Any], options: Options, places: Mapping[str, Place]) -> Reason:
    meaning = MEANINGS.get(name)
    if meaning is None:
        # A run of another version may have flags of its own.
        return Reason(name, "docs/quality.md explains this flag", None, "look at the tile")
    column = FLAGS.get(name)
    value = row.get(column) if column else None
    limit = getattr(options, column) if column else None
    words = meaning.words.format(value=_number(value, meaning.percent), limit=_number(limit, meaning.percent))
    place = places.get(name)
    return Reason(name, words, place, meaning.remedy.format(there=" there" if place else ""))


def described(options: Options) -> dict[str, dict[str, Any]]:
    """Return the flags for the page: words, remedy, column, limit and whether it is a share, by flag."""
    return {
        name: {
            "words": meaning.words,
            "remedy": meaning.remedy.format(there=""),
            "column": FLAGS.get(name),
            "limit": _number(getattr(options, FLAGS[name]), meaning.percent) if name in FLAGS else None,
            "percent": meaning.percent,
        }
        for name, meaning in MEANINGS.items()
    }


def coordinates(east: float, north: float) -> str:
    """Return a place as easting and northing in whole metres: ``588,612 / 4,519,130``."""
    # Half a metre is rounded up, as by the page's script.
    return " / ".join(f"{math.floor(value + 0.5):,}" for value in (east, north))


def _number(value: Any, percent: bool) -> str:
    if value is None or pd.isna(value):
        return "–"
    return f"{100 * value:.3g}%" if percent else f"{value:,.0f}" if value >= 100 else f"{value:.3g}"
