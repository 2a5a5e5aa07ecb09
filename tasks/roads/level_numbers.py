"""Levels of roads from their attributes: 0 on the ground, above 0 on decks, below 0 in tunnels."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flexroad.catalog.text import count, shown
from flexroad.tasks.roads.attributes import has_value, is_yes

OSM_TAGS = ("bridge", "tunnel", "covered", "layer")
LEVEL_COLUMNS = (
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
COLUMNS = (*OSM_TAGS, *LEVEL_COLUMNS, *STRUCTURE_COLUMNS)
"""All columns that are read for levels, in lower case."""
HIGHEST = 5
"""Levels are numbers from minus to plus this."""
UNKNOWN = 1000
"""Numbers from here on are codes for "unknown", as 999998 in swissTLM3D."""
NUMBER = re.compile(r"[+-]?\d+(?:[.,]0*)?")
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

Levels = NDArray[np.int64]


def level_numbers(table: Any) -> tuple[Levels, tuple[str, ...]]:
    """Return the level of every row, ``(n,)``, and a note per column with values that cannot be read.

    A row takes the first of these that it has: OSM's ``bridge`` or ``tunnel``, with the number in ``layer``;
    a number in one of `LEVEL_COLUMNS`; a word in one of `STRUCTURE_COLUMNS`. Without any it is on level 0.

    - `table`: its columns are named in lower case.
    """
    levels, notes = _osm(table), list[str]()
    for names, read in ((LEVEL_COLUMNS, _number), (STRUCTURE_COLUMNS, _structure)):
        for column in names:
            bad = []
            for i, value in enumerate(table.get(column, ())):
                if levels[i] is None and has_value(value):
                    text = str(value).strip().lower()
                    levels[i] = read(text)
                    bad += [str(value)] if levels[i] is None and not _is_unknown(text) else []
            if bad:
                notes.append(
                    f"{count(len(bad), 'value')} of the column {column} cannot be read as levels of roads "
                    f"({shown(bad[0])}): not used; correct them, or name the level in a column `level`"
                )
    return np.array([level or 0 for level in levels], np.int64), tuple(notes)


def _osm(table: Any) -> list[int | None]:
    """Return the level of every row that OSM's tags name, and None for the others.

    ``layer`` orders features only where they cross, so it counts on bridges and in tunnels alone. What lies
    below a bridge may have a layer below 0: the bridge is still a deck.
    """
    bridge, tunnel, covered = (is_yes(table, tag) for tag in ("bridge", "tunnel", "covered"))
    levels: list[int | None] = [None] * len(table)
    for i in np.flatnonzero(bridge | tunnel | covered):
        layer = _number(str(table["layer"].iloc[i]).strip()) if "layer" in table else None
        if bridge[i]:
            levels[i] = max(layer or 1, 1)
        elif tunnel[i] or (layer or 0) < 0:
            levels[i] = min(layer or -1, -1)
    return levels


def _number(text: str) -> int | None:
    """Return a level from a text in lower case; None if it is not one."""
    if text in AT_GROUND:
        return 0
    number = float(text.replace(",", ".")) if NUMBER.fullmatch(text) else np.nan
    return int(number) if abs(number) <= HIGHEST else None


def _structure(text: str) -> int | None:
    """Return the level of a word or code, perhaps the last part of an address; None if it is unknown."""
    # A column of numbers with gaps is one of floats: 1800.0.
    word = re.split("[/#]", text)[-1].removesuffix(".0").translate(UMLAUTS)
    return STRUCTURE_LEVEL.get(word)


def _is_unknown(text: str) -> bool:
    """Return whether a text is a code for "unknown"."""
    return NUMBER.fullmatch(text) is not None and abs(float(text.replace(",", "."))) >= UNKNOWN
