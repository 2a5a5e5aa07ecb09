"""The text of a road of OpenDRIVE with other profiles: all else in it stays as it was written."""

from __future__ import annotations

from collections.abc import Sequence

from flexroad.tasks.types import Floats
from flexroad.tools.lift.xml_text import Part

LATERAL = ("superelevation", "crossfall", "shape", "crossSectionSurface")
"""The elements of a lateral profile that are replaced."""
Edit = tuple[int, int, bytes]


def records(name: str, pieces: Floats) -> list[str]:
    """Return the elements of cubic pieces, ``(k, 5)``: s, a, b, c, d."""
    values = (zip("sabcd", row, strict=True) for row in pieces.tolist())
    texts = (" ".join(f'{key}="{value:.12g}"' for key, value in each) for each in values)
    return [f"<{name} {text}/>" for text in texts]


def with_profiles(road: Part, elevation: Sequence[str], lateral: Sequence[str] | None) -> bytes:
    """Return the text of a road with the elements of its profiles; missing ones are added in their place.

    - `elevation`, `lateral`: elements in ``elevationProfile`` and in ``lateralProfile``; None leaves the
      latter as it is.
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
    """Return where the last element of a name ends."""
    return road.spans[road.element.findall(name)[-1]][1]


def _replaced(road: Part, name: str, old: Sequence[str], body: str, around: str) -> list[Edit]:
    """Return the edits that replace some children of an element by others; the new ones come first."""
    element = road.element.find(name)
    assert element is not None
    place = road.inside(element)
    if place is None:
        start, end = road.start_tag(element)
        head = road.text[start:end].removesuffix(b"/>").rstrip()
        return [(start, end, head + f">{body}{around}</{name}>".encode("ascii"))] if body else []
    edits = [(place[0], place[0], body.encode("ascii"))]
    for child in element:
        if child.tag in old:
            start, end = road.spans[child]
            blank = len(road.text[place[0] : start]) - len(road.text[place[0] : start].rstrip())
            edits.append((start - blank, end, b""))
    return edits


def _indents(road: Part) -> tuple[str, str]:
    """Return the white space before the children of a road and before theirs; empty if it has no lines."""
    plan = road.element.find("planView")
    assert plan is not None
    found = []
    for element in (plan, plan[0]):
        before = road.text[: road.spans[element][0]]
        blank = before[len(before.rstrip()) :]
        found.append(blank[blank.rfind(b"\n") :].decode("ascii") if b"\n" in blank else "")
    return found[0], found[1]
