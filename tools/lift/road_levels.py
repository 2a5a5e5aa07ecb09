"""The level of roads that have several from end to end: that on which the roads linked with them go on."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from xml.etree import ElementTree as ET

import numpy as np

from flexroad.pipeline.run.points import Heights

Contact = tuple[str, bool]
"""A road and whether it is its end; else its start."""


@dataclass(frozen=True)
class Ends:
    """Heights at both ends of a road on each level that it may be on; one if it is known."""

    levels: Mapping[int, tuple[float, float]]
    linked: tuple[tuple[bool, Contact], ...]
    """Whether it is the road's end that has a link, and where the link leads."""


def several(line: Heights) -> list[int]:
    """Return the levels that all points of a line have; empty if it is the ground alone, or none."""
    found = [number for number, z in zip(line.numbers, line.z, strict=True) if np.isfinite(z).all()]
    return found if len(found) > 1 else []


def links(road: ET.Element) -> tuple[tuple[bool, Contact], ...]:
    """Return the links of a road to other roads."""
    found = []
    for name, at_end in (("predecessor", False), ("successor", True)):
        link = road.find(f"link/{name}")
        if link is not None and link.get("elementType") == "road":
            found.append((at_end, (link.get("elementId", ""), link.get("contactPoint") == "end")))
    return tuple(found)


def decided(roads: Mapping[str, Ends]) -> dict[str, int]:
    """Return the levels of roads that have several, of those that are linked with known ones.

    One whose neighbours are known takes the level that is nearest to their heights where they meet; it then
    is known to its own neighbours.
    """
    meets: dict[Contact, list[Contact]] = {}
    for name, road in roads.items():
        for at_end, other in road.linked:
            meets.setdefault((name, at_end), []).append(other)
            meets.setdefault(other, []).append((name, at_end))
    chosen: dict[str, int] = {}
    open_roads = [name for name, road in roads.items() if len(road.levels) > 1]
    while open_roads:
        new: dict[str, int] = {}
        for name in open_roads:
            known = [
                (end, z) for end in (False, True) for z in _known(roads, chosen, meets.get((name, end), ()))
            ]
            if known:
                levels = roads[name].levels
                away = {k: sum(abs(levels[k][end] - z) for end, z in known) for k in levels}
                new[name] = min(away, key=lambda k: (away[k], -k))
        if not new:
            break
        chosen |= new
        open_roads = [name for name in open_roads if name not in new]
    return chosen


def _known(roads: Mapping[str, Ends], chosen: Mapping[str, int], contacts: Sequence[Contact]) -> list[float]:
    """Return the heights of the known roads among some contacts."""
    found = []
    for name, at_end in contacts:
        if name in roads:
            levels = roads[name].levels
            number = chosen.get(name, next(iter(levels)) if len(levels) == 1 else None)
            if number is not None and np.isfinite(levels[number][at_end]):
                found.append(levels[number][at_end])
    return found
