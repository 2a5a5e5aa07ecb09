"""Values of columns, or of OSM's tags, in tables of roads: widths, lanes, levels.

Levels are 0 on the ground, above 0 on decks, below 0 in tunnels.
"""

from __future__ import annotations

import re
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator

from flexroad.catalog.text import count, shown
from flexroad.tasks import options as base
from flexroad.tasks.types import Bools, Floats

NO = ("", "no", "false", "f", "n", "0", "0.0", "nan", "<na>", "none")
"""Values that mean "no" or "unknown", in lower case."""

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
    "s1100": 11.5,
    "s1200": 9.0,
    "s1400": 8.0,
    "s1500": 3.0,
    "s1630": 7.0,
    "s1640": 6.0,
    "s1730": 4.5,
    "s1740": 4.0,
    "s1780": 6.0,
}
"""Width of carriageways (m) by class: of OSM, after the German guidelines (RAL 2012: RQ 31 per direction,
RQ 11; RASt 06); OSM maps each direction of a dual carriageway separately. For TIGER (MTFCC) they are assumed:
lanes of 12 ft with shoulders on primary and secondary roads, streets with parking on one side."""

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
WIDEST_M = 1000.0
"""Numbers from here on are codes for "unknown", such as 9998."""
LANE_WIDTH_M, SHOULDER_M = 3.25, 0.25
"""Width of a lane, and of the shoulder on either side (m): a road of two lanes is 7 m wide."""
MIN_WIDTH_M, MAX_WIDTH_M = 2.0, 40.0
"""Smallest and largest width of lines (m): values outside are errors of the data and are replaced."""
WIDTH_CLASS_COLUMNS = ("brv", "breiteDesVerkehrsweges")
"""Columns with a width in classes of 3 m, with shoulders; used without width and lanes."""
CLASS_STEP_M, LOWEST_CLASS_M = 3.0, 6.0
"""ATKIS gives ``breiteDesVerkehrsweges`` as the upper end of a class: 6 is up to 6 m, 9 is 6 to 9 m."""

OSM_TAGS = ("bridge", "tunnel", "covered", "layer")
NUMBER_COLUMNS = (
    "level",
    "relatievehoogteligging",
    "relatieve_hoogteligging",
    "position_par_rapport_au_sol",
    "pos_sol",
    "stufe",
)
"""Columns with a number; of the BGT (Netherlands), BD TOPO (France) and swissTLM3D."""
STRUCTURE_COLUMNS = ("kunstbaute", "verticalposition", "bauwerksfunktion", "bwf")
"""Columns with a word or code of a structure; of swissTLM3D, INSPIRE, and ATKIS and ALKIS (Germany)."""
LEVEL_COLUMNS = (*OSM_TAGS, *NUMBER_COLUMNS, *STRUCTURE_COLUMNS)
"""All columns that are read for levels, in lower case."""
HIGHEST_LEVEL = 5
"""Levels are numbers from minus to plus this."""
UNKNOWN_LEVEL = 1000
"""Numbers from here on are codes for "unknown", such as 999998 in swissTLM3D."""
LEVEL_NUMBER = re.compile(r"[+-]?\d+(?:[.,]0*)?")
AT_GROUND = ("gué ou radier",)
"""Values of number columns, in lower case, that mean a road on the ground: fords in BD TOPO."""

_BRIDGE_WORDS = (
    *("suspendedorelevated", "bruecke", "gedeckte bruecke", "bruecke mit galerie", "bruecke mit treppe"),
    *("auf gebaeude", "1800", "1801", "1802", "1803", "1804", "1805", "1806", "1807", "1808", "1810"),
    *("1820", "1830"),
)
_TUNNEL_WORDS = (
    *("underground", "tunnel", "unterfuehrung", "unterfuehrung mit treppe", "galerie", "in gebaeude"),
    *("1870", "1880", "1900"),
)
_GROUND_WORDS = (
    *("ongroundsurface", "keine", "staumauer", "staudamm", "furt", "k_w", "1840", "1845", "1850"),
    *("1890", "1910", "9999"),
)
STRUCTURE_LEVEL = {
    **dict.fromkeys(_BRIDGE_WORDS, 1),
    **dict.fromkeys(_TUNNEL_WORDS, -1),
    **dict.fromkeys(_GROUND_WORDS, 0),
}
"""Level by word or code, in lower case, with ``ue`` for ``ü``."""
UMLAUTS = str.maketrans({"ä": "ae", "ö": "oe", "ü": "ue"})


class Options(base.Options):
    """How the width of a line is found; the first that exists: width, number of lanes, width class, class."""

    width_columns: tuple[str, ...] = Field(
        ("width:carriageway", "width", "width_m", "est_width", "brf", "breiteDerFahrbahn"),
        description="columns (or OSM tags) with a width, kerb to kerb; the first with a value wins",
    )
    lane_columns: tuple[str, ...] = Field(
        ("lanes", "fsz", "anzahlDerFahrstreifen"),
        description="columns (or OSM tags) with the number of lanes; the first with a value wins",
    )
    width_unit: Literal["m", "ft"] = Field("m", description="unit of widths without one")
    class_width_m: dict[str, float] = Field(
        CLASS_WIDTH_M, description="width by class (m); entries replace entries of the built-in table"
    )
    default_width_m: float = Field(6.0, gt=0, le=100, description="width of lines without a known width (m)")

    @field_validator("class_width_m")
    @classmethod
    def _with_defaults(cls, class_width_m: dict[str, float]) -> dict[str, float]:
        if not all(0 < width <= 100 for width in class_width_m.values()):
            raise ValueError("a width must be above 0 and at most 100 m")
        return {**CLASS_WIDTH_M, **class_width_m}


def has_value(value: Any) -> bool:
    """Return whether a value of a table is not missing."""
    # pandas has several values for "missing".
    return value is not None and str(value).strip().lower() not in ("", "nan", "<na>", "none")


def is_yes(table: Any, column: str) -> Bools:
    """Return the rows whose value in a column is not in `NO`, ``(n,)``; no rows if the column is missing."""
    if column not in table:
        return np.zeros(len(table), bool)
    return np.array([str(value).strip().lower() not in NO for value in table[column]], bool)


def metres(text: str, bare_m: float = 1.0) -> float:
    """Return a width in metres, NaN if the text is not a length.

    - `text`: as in OSM's tag ``width``: ``7.5``, ``7,5``, ``2 m``, ``24'``, ``24'6"``, ``7 ft``.
    - `bare_m`: metres in the unit of a bare number.
    """
    text = text.strip().lower().translate(PRIMES)
    if both := FEET_INCHES.fullmatch(text):
        return int(both[1]) * FOOT_M + float(both[2]) * INCH_M
    length = LENGTH.fullmatch(text)
    if length is None:
        return float("nan")
    return float(length[1]) * (UNITS_M.get(length[2], float("nan")) if length[2] else bare_m)


def widths(table: Any, classes: Any, options: Options) -> tuple[Floats, tuple[str, ...]]:
    """Return the width of every row (m), ``(n,)``, and notes on missing or unreadable widths.

    - `table`: its columns may have widths and numbers of lanes; names in lower case.
    - `classes`: class of each row.
    """
    bare_m = FOOT_M if options.width_unit == "ft" else 1.0
    width, unreadable = np.full(len(table), np.nan), []
    for column in map(str.lower, options.width_columns):
        if column in table:
            values = [(i, str(text)) for i, text in enumerate(table[column]) if has_value(text)]
            for i, text in values:
                value = metres(text, bare_m)
                unreadable += [text] if np.isnan(value) else []
                # In many tables 0 means unknown.
                width[i] = value if np.isnan(width[i]) and 0 < value < WIDEST_M else width[i]
    by_class = np.array([options.class_width_m.get(str(name), np.nan) for name in classes], float)
    by_lanes = lanes(table, options) * LANE_WIDTH_M + 2 * SHOULDER_M
    upper = _numbers(table, WIDTH_CLASS_COLUMNS, LOWEST_CLASS_M, WIDEST_M)
    middle = np.where(upper == LOWEST_CLASS_M, LOWEST_CLASS_M / 2, upper - CLASS_STEP_M / 2)
    for other in (by_lanes, middle, by_class):
        width = np.where(np.isnan(width), other, width)
    unknown = int(np.isnan(width).sum())
    notes = []
    if unreadable:
        notes.append(
            f"{len(unreadable)} widths of lines cannot be read ({unreadable[0]!r}): "
            "lanes or class are used instead"
        )
    if unknown:
        notes.append(
            f"{unknown} of {len(width)} lines have no width, lanes or known class: taken as "
            f"{options.default_width_m:g} m wide"
        )
    width = np.where(np.isnan(width), options.default_width_m, width)
    return np.clip(width, MIN_WIDTH_M, MAX_WIDTH_M), tuple(notes)


def lanes(table: Any, options: Options) -> Floats:
    """Return the number of lanes of every row, ``(n,)``; NaN where it is unknown."""
    return _numbers(table, options.lane_columns, 1, MOST_LANES)


def _numbers(table: Any, columns: tuple[str, ...], lowest: float, highest: float) -> Floats:
    """Return the first number within limits of each row, ``(n,)``; NaN without such a number."""
    numbers = np.full(len(table), np.nan)
    for column in map(str.lower, columns):
        for i, text in enumerate(table.get(column, ())):
            if np.isnan(numbers[i]) and has_value(text) and re.fullmatch(NUMBER, str(text).strip()):
                number = float(text)
                numbers[i] = number if lowest <= number <= highest else np.nan
    return numbers


def level_numbers(table: Any) -> tuple[NDArray[np.int64], tuple[str, ...]]:
    """Return the level of every row, ``(n,)``, and a note per column with values that cannot be read.

    The first that a row has is used: OSM's ``bridge`` or ``tunnel``, with the number in ``layer``; a number
    in one of `NUMBER_COLUMNS`; a word in one of `STRUCTURE_COLUMNS`. Otherwise the level is 0.

    - `table`: its columns are named in lower case.
    """
    levels, notes = _osm(table), list[str]()
    for names, read in ((NUMBER_COLUMNS, _level), (STRUCTURE_COLUMNS, _structure)):
        for column in names:
            bad = []
            for i, value in enumerate(table.get(column, ())):
                if levels[i] is None and has_value(value):
                    text = str(value).strip().lower()
                    levels[i] = read(text)
                    is_code = (
                        LEVEL_NUMBER.fullmatch(text) and abs(float(text.replace(",", "."))) >= UNKNOWN_LEVEL
                    )
                    bad += [str(value)] if levels[i] is None and not is_code else []
            if bad:
                notes.append(
                    f"{count(len(bad), 'value')} of the column {column} cannot be read as levels of roads "
                    f"({shown(bad[0])}): not used; correct them, or name the level in a column `level`"
                )
    return np.array([level or 0 for level in levels], np.int64), tuple(notes)


def _osm(table: Any) -> list[int | None]:
    """Return the level of every row by OSM's tags, None for rows without these tags.

    ``layer`` orders features only where they cross, so it is used only on bridges and in tunnels. A bridge
    below another bridge may have a layer below 0: it is still a deck.
    """
    bridge, tunnel, covered = (is_yes(table, tag) for tag in ("bridge", "tunnel", "covered"))
    levels: list[int | None] = [None] * len(table)
    for i in np.flatnonzero(bridge | tunnel | covered):
        layer = _level(str(table["layer"].iloc[i]).strip()) if "layer" in table else None
        if bridge[i]:
            levels[i] = max(layer or 1, 1)
        elif tunnel[i] or (layer or 0) < 0:
            levels[i] = min(layer or -1, -1)
    return levels


def _level(text: str) -> int | None:
    """Return a level from a text in lower case; None if the text is not a level."""
    if text in AT_GROUND:
        return 0
    number = float(text.replace(",", ".")) if LEVEL_NUMBER.fullmatch(text) else np.nan
    return int(number) if abs(number) <= HIGHEST_LEVEL else None


def _structure(text: str) -> int | None:
    """Return the level of a word or code, perhaps the last part of an address; None if it is unknown."""
    # A column of numbers with gaps is read as floats: 1800.0.
    word = re.split("[/#]", text)[-1].removesuffix(".0").translate(UMLAUTS)
    return STRUCTURE_LEVEL.get(word)
