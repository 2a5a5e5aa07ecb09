"""Did the run work: the number of tiles in each state in words, each with the next command."""

from __future__ import annotations

import re
import shlex
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from flexroad.catalog.text import count, printable
from flexroad.pipeline.report.browser.reasons import MEANINGS
from flexroad.pipeline.report.browser.tiles import STATES, TileTable
from flexroad.pipeline.report.content import Content
from flexroad.tasks.quality.assess import NO_ROAD

MOST = 3
"""Kinds of errors that are told; the table of failures has all."""


@dataclass(frozen=True)
class Card:
    """One number at the top of the page."""

    kind: str
    """A key of `STATES`, or ``all``."""
    number: int
    name: str


@dataclass(frozen=True)
class Statement:
    """One line on the run, with what to do."""

    kind: str
    """``good``, ``flagged``, ``no-road``, ``failed`` or ``pending``."""
    text: str
    command: str = ""
    """The next command, ready to be pasted; empty if nothing has to be done."""


def headline(table: TileTable) -> str:
    """Return the answer in one sentence."""
    n, total = table.counts, len(table.tiles)
    done = n["fine"] + n["flagged"] + n["no-road"]
    if done == total:
        flagged = _are(n["flagged"], "flagged")
        return f"Yes: {_all(total)} done{f', {flagged}' if flagged else ', none is flagged'}."
    missing = " and ".join(filter(None, [_are(n["failed"], "failed", ""), _are(n["pending"], "pending")]))
    if not done:
        return f"No: no tile is done; {missing}."
    return f"In part: {done:,} of {count(total, 'tile')} are done; {missing}."


def cards(table: TileTable) -> list[Card]:
    """Return the numbers of the tiles in each state; states without tiles are left out but ``done``."""
    shown = [
        Card(state, table.counts[state], name)
        for state, name in STATES.items()
        if table.counts[state] or state == "fine"
    ]
    return [Card("all", len(table.tiles), "tiles"[: 5 if len(table.tiles) != 1 else 4]), *shown]


def statements(content: Content, table: TileTable, failed: Mapping[str, str], run: str) -> list[Statement]:
    """Return what is to be known of a run, the most urgent first.

    Parameters
    ----------
    content : Content
        The tables of the run.
    table : TileTable
        Its tiles.
    failed : Mapping
        The error of each failed tile by id.
    run : str
        Path of the run, for commands.
    """
    run = shlex.quote(run)
    return [
        *_last_run(content, run),
        *_failures(table.counts["failed"], failed, run),
        *_pending(table.counts["pending"], run, content.running),
        *_flagged(table),
        *_without_roads(content.counts.without_roads),
        *_surfaces(content),
        *_changes(content),
    ]


def _last_run(content: Content, run: str) -> Iterator[Statement]:
    if content.counts.refused:
        yield Statement("failed", f"The last run could not go on: {printable(content.counts.refused)}")
    if content.counts.interrupted:
        text = "The last run was interrupted; its tiles are kept."
        yield Statement("pending", text, f"flexroad rerun {run}")


def _failures(number: int, failed: Mapping[str, str], run: str) -> Iterator[Statement]:
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
    yield Statement("failed", text, f"flexroad rerun {run} --failed")


def _kind(error: str) -> str:
    """Return an error without numbers and names of files, in which errors of one kind differ."""
    return re.sub(r"\S*[\d/\\]\S*", "", error)


def _pending(number: int, run: str, running: bool) -> Iterator[Statement]:
    if number and running:
        yield Statement("pending", f"{_have(number)} no result yet; the run is in progress.")
    elif number:
        text = f"{_have(number)} no result for the current files and options:"
        yield Statement("pending", text, f"flexroad rerun {run}")


def _flagged(table: TileTable) -> Iterator[Statement]:
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
    yield Statement(
        "flagged",
        f"{count(number, 'done tile')} should be looked at, by {'its' if number == 1 else 'their'} flags: "
        f"{told}. Below is where.",
    )


def _without_roads(number: int) -> Iterator[Statement]:
    if number:
        remedy = MEANINGS[NO_ROAD].remedy.capitalize()
        yield Statement("no-road", f"{_have(number)} no road; the surface there is the terrain. {remedy}.")


def _surfaces(content: Content) -> Iterator[Statement]:
    """Say whether neighbouring tiles meet and meshes have no fault."""
    steps = content.steps.check
    own = steps[steps.variant == content.variant] if len(steps) else steps
    if len(own):
        row = own.iloc[0]
        bad = str(row.result).startswith("error")
        text = f"Neighbouring tiles ({count(int(row.edges), 'common edge')}): {row.result}."
        yield Statement("failed" if bad else "good", text)
    meshes = content.meshes[content.meshes.method == content.variant]
    if len(meshes):
        row = meshes.iloc[0]
        bad = bool(row["meshes with faults"])
        text = f"Meshes: {count(int(row.meshes), 'mesh').replace('meshs', 'meshes')} checked, {row.result}."
        yield Statement("failed" if bad else "good", text)


def _changes(content: Content) -> Iterator[Statement]:
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
        yield Statement("good", f"In the last run, tiles were: {', '.join(parts)}.")


def _all(total: int) -> str:
    return f"all {total:,} tiles are" if total > 1 else "the tile is"


def _are(number: int, what: str, verb: str = "is are") -> str:
    one, many = verb.split() if verb else ("", "")
    return " ".join(filter(None, [f"{number:,}", one if number == 1 else many, what])) if number else ""


def _have(number: int) -> str:
    return f"{count(number, 'tile')} {'has' if number == 1 else 'have'}"
