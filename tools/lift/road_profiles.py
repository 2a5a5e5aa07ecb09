"""Elevation and superelevation of a road of OpenDRIVE: computed from heights, and written into its text.

The elevation is the surface at the reference line. At both ends it has the height and the grade of the
surface, so roads that meet on the map also meet in height. The superelevation is the slope of the best
straight line of the cross-section through that height.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby

import numpy as np

from flexroad.tasks.types import Bools, Floats
from flexroad.tools.export.profiles import cubic_pieces, straight_lines
from flexroad.tools.export.reference_line import stretches
from flexroad.tools.lift.network import NOWHERE, Ends, filled
from flexroad.tools.lift.xml_text import Part

AHEAD_M = 0.05
"""Distance over which the slope of a surface is measured (m)."""
STEEPEST = 0.5
"""Largest slope across a road (m/m): a steeper surface has a step, or the end of a deck."""
LEAST_ACROSS_M = 0.25
"""Points nearer to the reference line are not used for the slope of a cross-section (m)."""
BREAK_M = 1e-3
"""The old profile continues at this distance after the ground (m)."""
LATERAL = ("superelevation", "crossfall", "shape", "crossSectionSurface")
"""The elements of a lateral profile that are replaced."""
Edit = tuple[int, int, bytes]


@dataclass(frozen=True, eq=False)
class CrossSections:
    """Heights of the surface at n distances along a road."""

    s: Floats
    """``(n,)``, m, ascending."""
    t: Floats
    """``(m,)``: distances from the reference line, ascending, positive to the left (m)."""
    z: Floats
    """``(n, m)``, m; NaN beyond the surface."""
    inside: Bools
    """``(n, m)``: the points on the lanes."""
    line: Floats
    """``(n,)``: heights on the reference line; NaN without a surface."""
    grade: Floats
    """``(n,)``: slope of the surface along the reference line."""
    joined: Bools
    """``(n,)``: places without ground where a profile is continued smoothly, as in a tunnel."""


def cross_sections(
    s: Floats, t: Floats, z: Floats, beside: tuple[Floats, Floats, Floats], inside: Bools, joined: Bools
) -> CrossSections:
    """Return cross-sections.

    - `s`, `t`, `z`, `inside`, `joined`: as in `CrossSections`.
    - `beside` ``(n,)``: heights on the reference line, and `AHEAD_M` before and after it.
    """
    on, before, after = beside
    used = np.where(inside, z, np.nan)
    known = np.isfinite(used)
    # Where the line is beside a deck, the cross-section is extended to the line.
    lost = ~np.isfinite(on) & (known.sum(axis=1) > 1)
    line = on.copy()
    for row in np.flatnonzero(lost):
        slope, at_line = np.polyfit(t[known[row]], used[row, known[row]], 1)
        line[row] = at_line if abs(slope) < STEEPEST else np.nan
    line[joined] = np.nan
    # A single place with ground gives no part of a profile.
    has = np.isfinite(line)
    beside_one = np.convolve(has, [1, 0, 1], "same") > 0
    line[~beside_one] = np.nan
    grade = (after - before) / (2 * AHEAD_M)
    for one_sided in ((after - on) / AHEAD_M, (on - before) / AHEAD_M):
        grade = np.where(np.isfinite(grade), grade, one_sided)
    missing = np.isfinite(line) & ~np.isfinite(grade)
    if missing.any():
        grade[missing] = np.nan_to_num(np.gradient(line, s))[missing]
    return CrossSections(s, t, z, inside, line, grade, joined)


def superelevation(sections: CrossSections, old: Floats, flat: bool, tolerance: float) -> Floats | None:
    """Return the pieces of the superelevation, ``(k, 5)``, radians; None if the road has no ground."""
    inside = sections.inside & np.isfinite(sections.z)
    away = np.where(inside, sections.t, 0.0)
    _, slope = straight_lines(sections.t, sections.z, inside, sections.line)
    known = np.isfinite(sections.line)
    good = known & np.isfinite(slope) & (np.abs(slope) < STEEPEST)
    good &= np.abs(away).max(axis=1, initial=0.0) >= LEAST_ACROSS_M
    s = sections.s
    angle = np.full(len(s), np.nan)
    if good.any():
        angle[known] = np.interp(s[known], s[good], np.arctan(slope[good]))
    elif known.any():
        angle[known] = 0.0
    reach = float(np.abs(sections.t).max(initial=1.0))
    return profile(sections, angle, _slopes(s, angle), old, flat, tolerance / max(reach, 1.0))


def profile(
    sections: CrossSections,
    values: Floats,
    slopes: Floats,
    old: Floats,
    flat: bool,
    tolerance: float,
    ends: Ends = NOWHERE,
) -> Floats | None:
    """Return pieces along the whole road, ``(k, 5)``; None if it has no ground.

    - `values`, `slopes` ``(n,)``: values of the surface, and their derivatives.
    - `old`: the old pieces, which stay beyond the ground.
    - `flat`: whether it is level there instead, or leads to ``ends``: heights of the nodes, NaN if unknown.
    """
    s, known = sections.s, np.isfinite(values)
    both = known[:-1] & known[1:]
    if not both.any():
        return None
    whole = filled(s, values, ends)
    parts, start = list[Floats](), 0
    for has, group in groupby(both.tolist()):
        end = start + len(list(group))
        if has:
            here = slice(start, end + 1)
            parts.append(cubic_pieces(s[here], values[here], slopes[here], tolerance))
        else:
            outer = start == 0 or end == len(both)
            if flat or (not outer and bool(sections.joined[start + 1 : end].all())):
                # Beyond the ground both slopes are 0.
                at = [start, end]
                parts.append(cubic_pieces(s[at], whole[at], np.zeros(2) if outer else slopes[at], np.inf))
            else:
                # The last place with ground still has its height.
                first = float(s[start]) + (BREAK_M if start else 0.0)
                parts.append(_part(old, first, float(s[end])))
        start = end
    return np.vstack(parts)


def _part(pieces: Floats, start: float, end: float) -> Floats:
    """Return the pieces between two distances; the first piece is cut at the start."""
    inner = pieces[(pieces[:, 0] > start) & (pieces[:, 0] < end)]
    first = pieces[max(int(np.searchsorted(pieces[:, 0], start, side="right")) - 1, 0)]
    s, a, b, c, d = first
    x = start - s
    moved = [start, a + x * (b + x * (c + x * d)), b + x * (2 * c + 3 * d * x), c + 3 * d * x, d]
    return np.vstack([moved, inner])


def _slopes(s: Floats, values: Floats) -> Floats:
    """Return the derivative of values along each stretch without NaN."""
    slopes = np.zeros(len(s))
    for start, end in stretches(np.isfinite(values)):
        if end - start > 1:
            slopes[start:end] = np.gradient(values[start:end], s[start:end])
    return slopes


def texts(name: str, pieces: Floats) -> list[str]:
    """Return the elements of cubic pieces, ``(k, 5)``: s, a, b, c, d."""
    values = (zip("sabcd", row, strict=True) for row in pieces.tolist())
    texts = (" ".join(f'{key}="{value:.12g}"' for key, value in each) for each in values)
    return [f"<{name} {text}/>" for text in texts]


def with_profiles(road: Part, elevation: Sequence[str], lateral: Sequence[str] | None) -> bytes:
    """Return the text of a road with new elements of its profiles; missing profiles are added.

    - `elevation`, `lateral`: elements in ``elevationProfile`` and in ``lateralProfile``. If ``lateral`` is
      None, the lateral profile does not change.
    """
    around, within = _indents(road)
    edits, added = list[Edit](), ""
    place = _end(road, "planView")
    for name, old, new in (
        ("elevationProfile", ("elevation",), elevation),
        ("lateralProfile", LATERAL, lateral),
    ):
        if new is None:
            continue
        body = "".join(within + each for each in new)
        if road.element.find(name) is not None:
            if added:
                edits.append((place, place, added.encode("ascii")))
            place, added = _end(road, name), ""
            edits += _replaced(road, name, old, body, around)
        else:
            added += f"{around}<{name}>{body}{around}</{name}>"
    if added:
        edits.append((place, place, added.encode("ascii")))
    return road.replaced(edits)


def _end(road: Part, name: str) -> int:
    """Return the end of the last element with a name."""
    return road.spans[road.element.findall(name)[-1]][1]


def _replaced(road: Part, name: str, old: Sequence[str], body: str, around: str) -> list[Edit]:
    """Return the edits that replace some children of an element; the new children come first."""
    element = road.element.find(name)
    assert element is not None
    place = road.inside(element)
    if place is None:
        return [road.with_child(element, body + around)] if body else []
    edits = [(place[0], place[0], body.encode("ascii"))]
    for child in element:
        if child.tag in old:
            start, end = road.spans[child]
            blank = len(road.text[place[0] : start]) - len(road.text[place[0] : start].rstrip())
            edits.append((start - blank, end, b""))
    return edits


def _indents(road: Part) -> tuple[str, str]:
    """Return the white space before children and grandchildren of a road; empty if the text is one line."""
    plan = road.element.find("planView")
    assert plan is not None
    found = []
    for element in (plan, plan[0]):
        before = road.text[: road.spans[element][0]]
        blank = before[len(before.rstrip()) :]
        found.append(blank[blank.rfind(b"\n") :].decode("ascii") if b"\n" in blank else "")
    return found[0], found[1]
