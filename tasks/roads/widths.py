"""How wide a road is, from what a table of centre lines says of it."""

from __future__ import annotations

import re
from typing import Any, Literal

import numpy as np
from pydantic import Field, field_validator

from flexroad.tasks import options as base
from flexroad.tasks.types import Floats

CLASS_WIDTH_M = {
    "motorway": 12.0,
    "motorway_link": 6.0,
    "trunk": 10.0,
    "trunk_link": 6.0,
    "primary": 8.0,
    "primary_link": 6.0,
    "secondary": 7.0,
    "secondary_link": 6.0,
    "tertiary": 6.5,
    "tertiary_link": 5.5,
    "unclassified": 5.5,
    "residential": 5.5,
    "living_street": 4.5,
    "service": 4.0,
    "busway": 6.5,
    "track": 3.0,
}
"""Carriageways as the German guidelines build them (RAL 2012: RQ 31 per direction, RQ 11; RASt 06), by OSM's
classes; of dual carriageways OSM draws each one."""

FOOT_M, INCH_M = 0.3048, 0.0254
UNITS_M = {
    **dict.fromkeys(("m", "metre", "metres", "meter", "meters"), 1.0),
    **dict.fromkeys(("cm", "centimetre", "centimetres", "centimeter", "centimeters"), 0.01),
    **dict.fromkeys(("ft", "foot", "feet", "'"), FOOT_M),
    **dict.fromkeys(("in", "inch", "inches", '"'), INCH_M),
}
NUMBER = r"\d+(?:\.\d*)?|\.\d+"
LENGTH = re.compile(rf"({NUMBER})\s*([a-z]+|'|\")?")
FEET_INCHES = re.compile(rf"(\d+)\s*(?:'|ft|feet)\s*({NUMBER})\s*(?:\"|in|inch|inches)")
PRIMES = str.maketrans({"’": "'", "′": "'", "”": '"', "″": '"', ",": "."})
MOST_LANES = 16


class Options(base.Options):
    """Where a line's width comes from: what it says itself, else its lanes, else its class."""

    width_columns: tuple[str, ...] = Field(
        ("width:carriageway", "width", "width_m", "est_width"),
        description="columns (or OSM tags) with a width, kerb to kerb; the first with a value wins",
    )
    width_unit: Literal["m", "ft"] = Field("m", description="unit of widths that name none")
    lane_width_m: float = Field(3.25, gt=0, le=10, description="width of a lane (m), where lanes are told")
    shoulder_m: float = Field(
        0.25, ge=0, le=10, description="beside the outer lanes on either side (m), where lanes are told"
    )
    class_width_m: dict[str, float] = Field(
        CLASS_WIDTH_M, description="width by class (m); what is given here lies over the built-in table"
    )
    default_width_m: float = Field(6.0, gt=0, le=100, description="width of lines nothing is known of (m)")
    min_width_m: float = Field(2.0, gt=0, le=100, description="narrower lines are taken as so wide (m)")
    max_width_m: float = Field(40.0, gt=0, le=100, description="wider lines are taken as so wide (m)")

    @field_validator("class_width_m")
    @classmethod
    def _over_the_table(cls, given: dict[str, float]) -> dict[str, float]:
        if not all(0 < width <= 100 for width in given.values()):
            raise ValueError("a width is above 0 and at most 100 m")
        return {**CLASS_WIDTH_M, **given}


def metres(text: str, bare_m: float = 1.0) -> float:
    """Return a width in metres, NaN if the text is no length.

    Parameters
    ----------
    text : str
        As in OSM's tag ``width``: ``7.5``, ``7,5``, ``2 m``, ``24'``, ``24'6"``, ``7 ft``.
    bare_m : float
        Metres in the unit of a bare number.
    """
    text = text.strip().lower().translate(PRIMES)
    if both := FEET_INCHES.fullmatch(text):
        return int(both[1]) * FOOT_M + float(both[2]) * INCH_M
    one = LENGTH.fullmatch(text)
    if one is None:
        return float("nan")
    return float(one[1]) * (UNITS_M.get(one[2], float("nan")) if one[2] else bare_m)


def widths(table: Any, classes: Any, options: Options) -> tuple[Floats, tuple[str, ...]]:
    """Return the width of every row (m), ``(n,)``, and notes on what was not to be read.

    Parameters
    ----------
    table : DataFrame
        Its columns may hold widths and ``lanes``; names in lower case.
    classes : sequence of str or None
        Class of each row.
    options : Options
        Where widths come from.
    """
    bare_m = FOOT_M if options.width_unit == "ft" else 1.0
    found, unread = np.full(len(table), np.nan), []
    for column in map(str.lower, options.width_columns):
        if column in table:
            told = [(i, str(text)) for i, text in enumerate(table[column]) if _is_told(text)]
            for i, text in told:
                width = metres(text, bare_m)
                unread += [text] if np.isnan(width) else []
                # Tables write 0 where they do not know.
                found[i] = width if np.isnan(found[i]) and width > 0 else found[i]
    by_class = np.array([options.class_width_m.get(str(name), np.nan) for name in classes], float)
    found = np.where(np.isnan(found), _by_lanes(table, options), found)
    found = np.where(np.isnan(found), by_class, found)
    unknown = int(np.isnan(found).sum())
    notes = []
    if unread:
        notes.append(f"{len(unread)} widths of lines cannot be read ({unread[0]!r}): lanes or class stand in")
    if unknown:
        notes.append(
            f"{unknown} of {len(found)} lines tell no width, lanes or known class: taken as "
            f"{options.default_width_m:g} m wide"
        )
    found = np.where(np.isnan(found), options.default_width_m, found)
    return np.clip(found, options.min_width_m, options.max_width_m), tuple(notes)


def _by_lanes(table: Any, options: Options) -> Floats:
    lanes = np.full(len(table), np.nan)
    for i, text in enumerate(table.get("lanes", ())):
        if _is_told(text) and re.fullmatch(NUMBER, str(text).strip()):
            lanes[i] = float(text)
    lanes[(lanes < 1) | (lanes > MOST_LANES)] = np.nan
    return lanes * options.lane_width_m + 2 * options.shoulder_m


def _is_told(value: Any) -> bool:
    # NaN alone is unlike itself; pandas has several ways to say "nothing".
    return value is not None and str(value).strip().lower() not in ("", "nan", "<na>", "none")
