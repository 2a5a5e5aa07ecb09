"""Files of the paper's dataset GeRoD, recognised by the words in their paths in whatever order.

The layout of the published archive is not known, but its ids are. The path of a file contains the south-west
corner of its tile (``295500_5629250``). The layer is given by the file's name, else by the nearest folder.
So ``{id}/dsm.tif``, ``{id}_DSM.tif``, ``dsm/{id}.tif`` and all of these below ``{stratum}/`` are read alike.
The class of area is a folder's name, or is given by a table beside the tiles (CSV or JSON).
"""

from __future__ import annotations

import csv
import json
import os
import re
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

from flexroad.catalog.storage.paths import read
from flexroad.catalog.text import access_reason, one_line, some
from flexroad.catalog.tile import LAYERS

SHA256 = "411fac10f29ec53be5840c10bc8eb45f3dc75f08721ab25ea3d49ba7fc8d7ff1"
"""Checksum of the published ``GeRoD.zip`` (1.4 GB)."""
TILES = 240
"""Number of tiles of the dataset."""
NAMED = (
    "295500_5629250", "296000_5629250", "296500_5629250", "296750_5629250",
    "346250_5676500", "346750_5676500", "354000_5700750", "359250_5654000",
    "369250_5680750", "381250_5760000", "395750_5708750", "407250_5673500",
)  # fmt: skip
"""Ids of tiles that the paper and its project page name."""
ID = re.compile(r"(?<!\d)(\d{6}_\d{7})(?!\d)")
"""South-west corner of a tile: easting and northing in whole metres (EPSG:25832)."""
POINTS = ".npz"
RASTERS = (".tif", ".tiff", ".asc", ".xyz", ".jp2")
TABLES = (".csv", ".json", ".geojson")
MAX_TABLE_BYTES = 10_000_000
NAMES = (
    ("above_ground", r"n(dom|dsm)|cdsm|chm|dhm|mnh|ndhm"),
    ("road_height", r"road.?heights?"),
    ("dsm", r"dsm|dom|mns|mds|surface"),
    ("dtm", r"dtm|dgm|dem|mnt|mdt|terrain|ground|bare"),
    ("dop", r"dop|ortho|orthophoto|rgbi?|cir"),
    ("road_mask", r"mask|landcover|land.?use|roads?"),
)
"""Layer and the words in names of files or folders that mean it, the first match first."""
OWN_NAMES = (
    ("reference", r"ref(erence)?|gt|ground.?truth|truth|drm|ext(ended)?.?(dtm|dgm)|(dtm|dgm).?ext(ended)?"),
    ("bridges", r"bridges?"),
    *NAMES,
    ("road_mask", r"seg(mentation)?|labels?|dino(v2)?"),
)
"""As `NAMES`, with the layers that only the dataset has."""
STRATA = {"urban": r"urban", "suburban": r"sub.?urban", "rural": r"rural"}
"""Class of area and the words that mean it."""


@dataclass(frozen=True)
class Found:
    """One file of the dataset."""

    name: str
    """Path relative to the folder."""
    tile: str
    layer: str
    """One of `LAYERS`; for ``.npz`` the layer of the heights of its points."""
    stratum: str
    """Class of area, or empty if it is unknown."""

    @property
    def pattern(self) -> str:
        """The path with ``{tile}`` and ``{stratum}`` in place of this file's."""
        parts = self.name.replace(self.tile, "{tile}").split("/")
        return "/".join("{stratum}" if stratum_of(part) else part for part in parts)


def find(root: Path) -> tuple[list[Found], list[str]]:
    """Return the files of the dataset below a folder, by path, and notes on unclear files.

    - `root`: the folder; its own name means nothing.
    """
    names = list(_names(root))
    of_tile, notes = _strata(root, [name for name in names if name.lower().endswith(TABLES)])
    found, unclear = [], []
    for name in names:
        if not name.lower().endswith((POINTS, *RASTERS)):
            continue
        tiles = ID.findall(name)
        layer = layer_of(name, OWN_NAMES) or ("dsm" if name.lower().endswith(POINTS) else "")
        if tiles and layer in LAYERS:
            folders = map(stratum_of, reversed(PurePosixPath(name).parts[:-1]))
            stratum = next(filter(None, folders), "") or of_tile.get(tiles[-1], "")
            found.append(Found(name, tiles[-1], layer, stratum))
        elif tiles:
            unclear.append(name)
    if unclear:
        notes.append(f"not a layer by the name: {some(unclear)}; describe the files with --layout")
    points = {file: file.name.lower().endswith(POINTS) for file in found}
    # Points are left out where the tile also has a raster of the layer.
    rasters = {(file.tile, file.layer) for file in found if not points[file]}
    return [file for file in found if not points[file] or (file.tile, file.layer) not in rasters], notes


def layer_of(name: str, words: Sequence[tuple[str, str]] = NAMES) -> str:
    """Return the layer by a file's name, else by the nearest folder, else an empty text."""
    path = PurePosixPath(name)
    for part in (path.stem, *reversed(path.parts[:-1])):
        for layer, pattern in words:
            if re.search(rf"(?<![a-z])({pattern})(?![a-z])", part.lower()):
                return layer
    return ""


def stratum_of(text: str) -> str:
    """Return the class of area that a text names, or an empty text."""
    word = text.strip().lower()
    return next((name for name, pattern in STRATA.items() if re.fullmatch(pattern, word)), "")


def table(found: Sequence[Found]) -> list[str]:
    """Return the found files as lines of a table: layer, number of tiles, and an example of the path."""
    by_layer: dict[str, list[Found]] = defaultdict(list)
    for file in found:
        by_layer[file.layer].append(file)
    rows = [("layer", "tiles", "files")]
    for layer in LAYERS:
        if files := by_layer[layer]:
            (pattern, _), *others = Counter(file.pattern for file in files).most_common()
            more = f" and {len(others)} more patterns" if others else ""
            rows.append((layer, str(len({file.tile for file in files})), pattern + more))
    strata = Counter({file.tile: file.stratum for file in found}.values())
    named = [f"{strata[name]} {name}" for name in STRATA if strata[name]]
    if named:
        rows.append(("stratum", str(sum(strata[name] for name in STRATA)), ", ".join(named)))
    widths = [max(len(row[column]) for row in rows) for column in (0, 1)]
    return [f"{row[0]:{widths[0]}}  {row[1]:>{widths[1]}}  {row[2]}" for row in rows]


def questions(found: Sequence[Found]) -> list[str]:
    """Return questions to the user about layers and classes of area that the files do not have."""
    tiles = {file.tile for file in found}
    have: dict[str, set[str]] = defaultdict(set)
    for file in found:
        have[file.layer].add(file.tile)
        if file.stratum:
            have["stratum"].add(file.tile)
    have["reference"] |= have["bridges"]
    asked = {
        "dsm": "a tile needs its surface model",
        "dtm": "a tile needs its terrain model",
        "road_mask": "which files say where road is?",
        "reference": "which files have the DTM with bridges? Without, the DTM is the reference",
        "stratum": "which tiles are urban, suburban and rural? Give a CSV with tile and stratum",
    }
    lines = []
    for name, question in asked.items():
        if lacking := sorted(tiles - have[name]):
            lines.append(f"no {name} for {len(lacking)} of {len(tiles)} tiles ({some(lacking)}): {question}")
    return lines


def _names(root: Path) -> Iterator[str]:
    for parent, folders, names in os.walk(root):
        # Hidden files, and the copies of names that macOS puts into archives.
        folders[:] = sorted(name for name in folders if not name.startswith((".", "__MACOSX")))
        shown = (name for name in sorted(names) if not name.startswith("."))
        yield from (Path(parent, name).relative_to(root).as_posix() for name in shown)


def _strata(root: Path, names: Sequence[str]) -> tuple[dict[str, str], list[str]]:
    """Return the class of area by tile from tables, and notes on tables that cannot be read."""
    strata, notes = dict[str, str](), list[str]()
    for name in names:
        try:
            if (root / name).stat().st_size <= MAX_TABLE_BYTES:
                text = read(root / name).decode("utf-8-sig")
                if name.lower().endswith(".csv"):
                    # One separator for all: ids and strata have neither.
                    parsed: Any = [";".join(line).split(";") for line in csv.reader(text.splitlines())]
                else:
                    parsed = json.loads(text)
                strata |= dict(_pairs(parsed, "", ""))
        except (OSError, ValueError, csv.Error, RecursionError) as error:
            notes.append(f"{name} was not read: {access_reason(error) or one_line(error)}")
    return strata, notes


def _pairs(node: Any, tile: str, stratum: str) -> Iterator[tuple[str, str]]:
    """Yield id and class of area where both are together: in a row, an object, or a key and its value."""
    if isinstance(node, Mapping | list):
        keyed = list(node.items()) if isinstance(node, Mapping) else [("", value) for value in node]
        flat = [value for _, value in keyed if isinstance(value, str)]
        ids, words = {*map(_id, flat)} - {""}, {*map(stratum_of, flat)} - {""}
        if len(ids) == 1:
            (tile,) = ids
        if len(words) == 1:
            (stratum,) = words
        if tile and stratum:
            yield tile, stratum
        for key, value in keyed:
            yield from _pairs(value, _id(key) or tile, stratum_of(key) or stratum)
    elif isinstance(node, str):
        tile, stratum = _id(node) or tile, stratum_of(node) or stratum
        if tile and stratum:
            yield tile, stratum


def _id(text: str) -> str:
    found = ID.findall(text)
    return found[0] if len(found) == 1 else ""
