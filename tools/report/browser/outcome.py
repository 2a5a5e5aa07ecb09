"""Texts of the page: whether the run worked, why tiles are flagged, and what to do."""

from __future__ import annotations

import math
import re
import shlex
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import pandas as pd

from flexroad.catalog.text import count, printable
from flexroad.tasks.io.dsm_and_dtm import is_offset
from flexroad.tasks.quality.assess import (
    BELOW,
    FLAGS,
    LEAST_RISE_M,
    LIMITS,
    NO_ABUTMENT,
    NO_RISE,
    NO_ROAD,
)
from flexroad.tasks.quality.flagged import Place
from flexroad.tools.report.browser.tiles import STATES, TileTable, short
from flexroad.tools.report.content import MESHES, STEPS, Content

OF_HEIGHTS = ("dropped", NO_ROAD)
"""Flags caused by a DSM far from the DTM."""
MOST = 3
"""Largest number of kinds of errors in a statement; the table of failures has all."""


@dataclass(frozen=True)
class _Meaning:
    """The meaning of a flag."""

    words: str
    """Description of the fault, with ``{value}`` and ``{limit}``."""
    remedy: str
    """Advice, with ``{there}`` for the flag's place."""
    percent: bool = False
    """Whether value and limit are shares, which are shown in percent."""


MEANINGS = {
    "error-estimate": _Meaning(
        "the surface is {value} m from DSM and DTM on average (limit {limit} m)",
        "compare DSM and DTM{there}: one of them is wrong or older",
    ),
    "worst-error": _Meaning(
        "25 m² of road in one piece are {value} m off or more (limit {limit} m)",
        "look{there} for an object that the road climbs, a deck that ends in the air, or a wrong DTM",
    ),
    "patch": _Meaning(
        "{value} m² of road in one piece are far from both DSM and DTM (limit {limit} m²)",
        "look for a bridge (`flexroad catalog check` maps bridges), a tree or a gap in the data{there}",
    ),
    "spike": _Meaning(
        "the surface bends more than a road can ({value} 1/m, limit {limit} 1/m)",
        "look at the mask{there}: it may reach over a wall, a roof or a bank",
    ),
    "edge-step": _Meaning(
        "the surface steps by {value} m at the road's edge (limit {limit} m)",
        "look at the mask{there}: it may be wider than the road, or shifted",
    ),
    "loose": _Meaning(
        "5% of the kept road points are more than {value} m from the surface (limit {limit} m)",
        "look for cars, trees or a second level{there} that the filter kept",
    ),
    "off-dtm": _Meaning(
        "{value} of the road lie off the DTM (limit {limit})",
        "a bridge is right (`flexroad catalog check` maps bridges); otherwise the DTM is wrong or "
        "older{there}",
        percent=True,
    ),
    "inferred": _Meaning(
        "{value} of the road have no height in the data (limit {limit})",
        "fill the gap in the data{there}, or take the road out of the mask",
        percent=True,
    ),
    "dropped": _Meaning(
        "the filter dropped {value} of the road mask (limit {limit})",
        "look whether there is a road{there} at all, or trees above it",
        percent=True,
    ),
    "weights": _Meaning(
        "{value} of the NURBS weights are at their limit (limit {limit})",
        "use fit.weights: unit",
        percent=True,
    ),
    BELOW: _Meaning(
        "a deck lies partly below the ground under it, or a tunnel above it",
        "look at the table of decks and tunnels, and at the heights and the outline of the deck",
    ),
    NO_RISE: _Meaning(
        f"a deck hardly lies above the ground, or a tunnel below it (less than {LEAST_RISE_M:g} m)",
        "a culvert is right; otherwise check the level and the outline of this road",
    ),
    NO_ABUTMENT: _Meaning(
        "no road of level 0 continues a deck",
        "check the level of the roads at its ends, and gaps there; level 0 ends by itself",
    ),
    NO_ROAD: _Meaning(
        "no road was found on the tile, so its surface is the terrain",
        "if there is a road, check the road source of the catalog and the options of segment and ecsrc",
    ),
}
"""Meaning of each flag."""


def reasons(
    row: Mapping[str, Any], places: Mapping[str, Place], notes: Sequence[str] = ()
) -> list[tuple[str, str]]:
    """Return a tile's flags, each with a description, a place and advice.

    - `row`: the tile's row of metrics.parquet.
    - `places`: place of each flag, as far as known (`flexroad.tasks.quality.flagged.places`).
    - `notes`: notes on the sources of the tile. A note on a DSM that lies off the whole DTM explains dropped
      roads.
    """
    given = row.get("flags")
    names = given.split(", ") if isinstance(given, str) and given else []
    what, _, cause = next(filter(is_offset, notes), "").partition(": ")
    offset = f"{what} ({cause})" if what else ""
    return [
        (name, _reason(name, row, places.get(name), offset if name in OF_HEIGHTS else "")) for name in names
    ]


def _reason(name: str, row: Mapping[str, Any], place: Place | None, remedy: str) -> str:
    meaning = MEANINGS.get(name)
    if meaning is None:
        # A run of another version may have other flags.
        return "docs/quality.md explains this flag; look at the tile"
    column = FLAGS.get(name)
    value = row.get(column) if column else None
    limit = _number(LIMITS.get(name), meaning.percent)
    words = meaning.words.format(value=_number(value, meaning.percent), limit=limit)
    at = f", at {coordinates(*place)}" if place else ""
    return f"{words}{at}; {remedy or meaning.remedy.format(there=' there' if place else '')}"


def described() -> dict[str, dict[str, Any]]:
    """Return the flags for the page: words, remedy, column, limit and whether it is a share, by flag."""
    return {
        name: {
            "words": meaning.words,
            "remedy": meaning.remedy.format(there=""),
            "column": FLAGS.get(name),
            "limit": _number(LIMITS[name], meaning.percent) if name in LIMITS else None,
            "percent": meaning.percent,
        }
        for name, meaning in MEANINGS.items()
    }


def coordinates(east: float, north: float) -> str:
    """Return a place as easting and northing in whole metres: ``588,612 / 4,519,130``."""
    # Half a metre is rounded up, like in the page's script.
    return " / ".join(f"{math.floor(value + 0.5):,}" for value in (east, north))


def _number(value: Any, percent: bool) -> str:
    if value is None or pd.isna(value):
        return "–"
    return f"{100 * value:.3g}%" if percent else short(value)


@dataclass(frozen=True)
class _Statement:
    """One line on the run, with advice."""

    kind: str
    """``good``, ``flagged``, ``no-road``, ``failed`` or ``pending``."""
    text: str
    command: str = ""
    """The next command, ready to be pasted; empty if no command is needed."""


def headline(table: TileTable, skipped: int = 0) -> str:
    """Return the outcome in one sentence; ``skipped`` is the number of files that the catalog lacks."""
    n, total = table.counts, len(table.tiles)
    done = n["fine"] + n["flagged"] + n["no-road"]
    if done == total and skipped:
        return f"In part: {_all(total)} done, but the catalog skipped {count(skipped, 'file')}."
    if done == total:
        flagged = _are(n["flagged"], "flagged")
        return f"Yes: {_all(total)} done{f', {flagged}' if flagged else ', none is flagged'}."
    missing = " and ".join(filter(None, [_are(n["failed"], "failed", ""), _are(n["pending"], "pending")]))
    if not done:
        return f"No: no tile is done; {missing}."
    return f"In part: {done:,} of {count(total, 'tile')} are done; {missing}."


def cards(table: TileTable) -> list[tuple[str, int, str]]:
    """Return the numbers at the top of the page: key of `STATES` or ``all``, number of tiles, and name.

    States without tiles are left out, except ``done``.
    """
    shown = [
        (state, table.counts[state], name)
        for state, name in STATES.items()
        if table.counts[state] or state == "fine"
    ]
    return [("all", len(table.tiles), "tiles"[: 5 if len(table.tiles) != 1 else 4]), *shown]


def statements(content: Content, table: TileTable, failed: Mapping[str, str], run: str) -> list[_Statement]:
    """Return the statements on a run, the most urgent first.

    - `failed`: the error of each failed tile by id.
    """
    run = shlex.quote(run)
    return [
        *_last_run(content, run),
        *_skipped(content),
        *_failures(table.counts["failed"], failed, run),
        *_pending(table.counts["pending"], run, content.running),
        *_flagged(table),
        *_without_roads(content.counts.without_roads),
        *_surfaces(content),
        *_changes(content),
    ]


def _last_run(content: Content, run: str) -> Iterator[_Statement]:
    if content.counts.refused:
        yield _Statement("failed", f"The last run could not continue: {printable(content.counts.refused)}")
    if content.counts.interrupted:
        text = "The last run was interrupted; its tiles are kept."
        yield _Statement("pending", text, f"flexroad rerun {run}")


def _skipped(content: Content) -> Iterator[_Statement]:
    """Return a statement on files that the catalog lacks: no tile shows them."""
    counts = content.counts
    if not counts.skipped:
        return
    more = len(counts.left_out) - MOST
    told = "; ".join([*map(printable, counts.left_out[:MOST]), *([f"{more} more"] if more > 0 else [])])
    text = (
        f"The catalog lacks {count(counts.skipped, 'file')} that cannot be used: {told}. Repair what was "
        "skipped, repeat the `flexroad catalog` command, then `flexroad run`."
    )
    yield _Statement("failed", text)


def _failures(number: int, failed: Mapping[str, str], run: str) -> Iterator[_Statement]:
    if not number:
        return
    kinds = Counter(_kind(text) for text in failed.values())
    examples = {_kind(text): text for text in reversed(list(failed.values()))}
    told = "; ".join(
        f"{printable(examples[kind])}{f' ({n} tiles of this kind)' if n > 1 else ''}"
        for kind, n in kinds.most_common(MOST)
    )
    more = f"; {count(len(kinds) - MOST, 'other kind')} in the details" if len(kinds) > MOST else ""
    text = f"{count(number, 'tile')} failed. {told}{more}. Correct the cause, then compute only those:"
    yield _Statement("failed", text, f"flexroad rerun {run} --failed")


def _kind(error: str) -> str:
    """Return an error without numbers and file names: so errors of one kind are equal."""
    return re.sub(r"\S*[\d/\\]\S*", "", error)


def _pending(number: int, run: str, running: bool) -> Iterator[_Statement]:
    if number and running:
        yield _Statement("pending", f"{_have(number)} no result yet; the run is in progress.")
    elif number:
        text = f"{_have(number)} no result for the current files and options:"
        yield _Statement("pending", text, f"flexroad rerun {run}")


def _flagged(table: TileTable) -> Iterator[_Statement]:
    number = table.counts["flagged"]
    if not number:
        return
    names = Counter(
        name
        for flags in table.frame["flags"].dropna()
        for name in str(flags).split(", ")
        if name and name != NO_ROAD
    )
    told = ", ".join(f"{name} {n:,}" for name, n in names.most_common())
    yield _Statement(
        "flagged",
        f"{count(number, 'done tile')} should be looked at, by {'its' if number == 1 else 'their'} flags: "
        f"{told}. Below is where.",
    )


def _without_roads(number: int) -> Iterator[_Statement]:
    if number:
        remedy = MEANINGS[NO_ROAD].remedy.capitalize()
        yield _Statement("no-road", f"{_have(number)} no road; the surface there is the terrain. {remedy}.")


def _surfaces(content: Content) -> Iterator[_Statement]:
    """Return statements on steps between tiles and faults of meshes."""
    steps, _ = content.tables[STEPS]
    own = steps[steps.variant == content.variant] if len(steps) else steps
    if len(own):
        row = own.iloc[0]
        bad = str(row.result).startswith("error")
        text = f"Neighbouring tiles ({count(int(row.edges), 'common edge')}): {row.result}."
        yield _Statement("failed" if bad else "good", text)
    meshes, _ = content.tables[MESHES]
    own = meshes[meshes.method == content.variant]
    if len(own):
        row = own.iloc[0]
        bad = bool(row["meshes with faults"])
        text = f"Meshes: {count(int(row.meshes), 'mesh').replace('meshs', 'meshes')} checked, {row.result}."
        yield _Statement("failed" if bad else "good", text)


def _changes(content: Content) -> Iterator[_Statement]:
    counts = content.counts
    parts = [
        f"{number} {what}"
        for number, what in (
            (counts.new, "new"),
            (counts.changed, "changed"),
            (counts.cached, "as before"),
            (counts.vanished, "gone from the catalog"),
        )
        if number
    ]
    if parts and (counts.changed or counts.cached or counts.vanished):
        yield _Statement("good", f"In the last run, tiles were: {', '.join(parts)}.")


def _all(total: int) -> str:
    return f"all {total:,} tiles are" if total > 1 else "the tile is"


def _are(number: int, what: str, verb: str = "is are") -> str:
    one, many = verb.split() if verb else ("", "")
    return " ".join(filter(None, [f"{number:,}", one if number == 1 else many, what])) if number else ""


def _have(number: int) -> str:
    return f"{count(number, 'tile')} {'has' if number == 1 else 'have'}"
