"""Folders with one file per tile and layer, told by templates such as ``{stratum}/{tile}/dsm.tif``.

A template is a path relative to the folder: ``{tile}`` stands for the tile's id and ``{stratum}`` for its
class of area, each a part of a name without a slash; ``*`` stands for anything without one.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from itertools import islice
from pathlib import Path
from typing import Any

from flexroad.catalog.errors import CatalogError
from flexroad.catalog.grid import Grid
from flexroad.catalog.headers.rasters import RasterFile, opened, require_metric, some
from flexroad.catalog.tile import LAYERS, Layer, Tile
from flexroad.catalog.tiling import MASKS, TilingResult, assumed, taken

NEEDED = ("dsm", "dtm")
PLACEHOLDER = re.compile(r"\{(.*?)\}")


@dataclass(frozen=True)
class Layout:
    """Where the files of a dataset lie, and what they leave unsaid."""

    layers: Mapping[str, str]
    """Template by layer (see `catalog.LAYERS`)."""
    road_values: tuple[int, ...] = ()
    """Cell values that mean road in the masks; empty: every value but 0 and nodata."""
    crs: str | None = None
    """CRS of files that carry none."""

    def __post_init__(self) -> None:
        for name, template in self.layers.items():
            if name not in LAYERS:
                raise CatalogError(f"layout: no layer is called {name!r}; there are {', '.join(LAYERS)}")
            names = PLACEHOLDER.findall(template)
            if "tile" not in names or not set(names) <= {"tile", "stratum"}:
                raise CatalogError(
                    f"layout: {name}: {template!r} needs {{tile}} and may have {{stratum}} and *, no other"
                )
        for name in NEEDED:
            if name not in self.layers:
                raise CatalogError(f"layout: no template for {name}; a tile needs {' and '.join(NEEDED)}")

    @classmethod
    def of(cls, raw: Mapping[str, Any]) -> Layout:
        """Return the layout that a configuration's ``dataset`` describes.

        Raises
        ------
        CatalogError
            If a key is unknown, a value is of the wrong kind, or a template is none.
        """
        kinds = {
            "layers": (dict, "a mapping of layers to templates"),
            "crs": (str, "a CRS such as EPSG:25832"),
        }
        kinds["road_values"] = (list, "a list of whole numbers")
        for key, value in raw.items():
            if key not in kinds:
                raise CatalogError(f"layout: no key is called {key!r}; there are {', '.join(kinds)}")
            if not isinstance(value, kinds[key][0]):
                raise CatalogError(f"layout: {key}: expected {kinds[key][1]}, not {value!r}")
        if not all(isinstance(template, str) for template in raw.get("layers", {}).values()):
            raise CatalogError(f"layout: layers: a template is text, unlike one of {raw['layers']!r}")
        if not all(isinstance(value, int) for value in raw.get("road_values", [])):
            raise CatalogError(f"layout: road_values: expected whole numbers, not {raw['road_values']!r}")
        return cls(raw.get("layers", {}), tuple(raw.get("road_values", ())), raw.get("crs"))


@dataclass(frozen=True)
class _Found:
    """A file, and what its template read from its name."""

    file: RasterFile
    stratum: str


def read(root: Path, layout: Layout, *, dataset: str, date: datetime | None = None) -> TilingResult:
    """Return the tiles of a folder; the cells of a tile are those of its DSM file.

    Parameters
    ----------
    root : Path
        The folder.
    layout : Layout
        Where its files lie.
    dataset : str
        What reports call the data.
    date : datetime, optional
        When the data was taken; overrules the files.

    Raises
    ------
    CatalogError
        If no DSM is found, two files are the same layer of a tile, or one is not in metres.
    """
    if not root.is_dir():
        raise CatalogError(f"folder {root} does not exist")
    root, notes = root.resolve(), []
    by_layer: dict[str, dict[str, _Found]] = {}
    for name in LAYERS:
        if name in layout.layers:
            by_layer[name], said = _files(root, name, layout)
            notes += said
    if not by_layer["dsm"]:
        raise CatalogError(
            f"no file of use matches {layout.layers['dsm']!r} (dsm) below {root}; {_seen(root, notes)}"
        )
    tiles = tuple(
        _tile(
            root,
            tile_id,
            {name: files[tile_id] for name, files in by_layer.items() if tile_id in files},
            layout,
            dataset,
            date,
        )
        for tile_id in sorted(by_layer["dsm"])
    )
    return TilingResult(tiles, (*notes, *_lacking(tiles, layout), *assumed(tiles)))


def _files(root: Path, layer: str, layout: Layout) -> tuple[dict[str, _Found], list[str]]:
    """Return the files of a layer by tile, and what was skipped."""
    template = layout.layers[layer]
    pattern = _pattern(template)
    try:
        paths = sorted(path for path in root.glob(PLACEHOLDER.sub("*", template)) if path.is_file())
    except (ValueError, NotImplementedError) as error:
        raise CatalogError(f"layout: {layer}: {template!r} is no path below {root}: {error}") from error
    told = {path.relative_to(root).as_posix(): path for path in paths}
    parts = {name: match.groupdict() for name in told if (match := pattern.fullmatch(name))}
    files, notes = opened(root, layer, [told[name] for name in parts], layout.crs)
    found: dict[str, _Found] = {}
    for file in files:
        tile_id = parts[file.name]["tile"]
        if tile_id in found:
            raise CatalogError(
                f"{found[tile_id].file.name} and {file.name} are both the {layer} of tile {tile_id}; "
                f"make its template {template!r} tell them apart"
            )
        found[tile_id] = _Found(file, parts[file.name].get("stratum") or "")
    return found, notes


def _pattern(template: str) -> re.Pattern[str]:
    """Return the expression that reads a tile's id and stratum from a path."""
    named: set[str] = set()
    parts = []
    for part in re.split(r"(\{.*?\}|\*)", template):
        name = part.strip("{}") if part.startswith("{") else ""
        if name:
            parts.append(f"(?P={name})" if name in named else f"(?P<{name}>[^/]+)")
            named.add(name)
        else:
            parts.append("[^/]*" if part == "*" else re.escape(part))
    return re.compile("".join(parts))


def _tile(
    root: Path, tile_id: str, found: Mapping[str, _Found], layout: Layout, dataset: str, date: datetime | None
) -> Tile:
    dsm = found["dsm"].file
    require_metric(dsm)
    layers = tuple(
        Layer(
            name,
            (one.file.name,),
            layout.road_values if name in MASKS else (),
            None if one.file.has_crs else layout.crs,
        )
        for name, one in found.items()
    )
    stratum = next((one.stratum for one in found.values() if one.stratum), "")
    grid = Grid.covering(dsm.crs, dsm.bounds, dsm.cell)
    return Tile(tile_id, grid, layers, str(root), *taken([dsm], date), stratum=stratum, dataset=dataset)


def _lacking(tiles: Sequence[Tile], layout: Layout) -> list[str]:
    """Return a note on each layer that tiles lack although there is a template for it."""
    notes = []
    for name in layout.layers:
        lacking = [tile.id for tile in tiles if tile.layer(name) is None]
        if lacking:
            share = f"{len(lacking)} of {len(tiles)} tiles"
            notes.append(f"no {name} at {layout.layers[name]!r} for {share}: {some(lacking)}")
    return notes


def _seen(root: Path, notes: Sequence[str]) -> str:
    if notes:
        return notes[0]
    files = sorted(
        islice((path.relative_to(root).as_posix() for path in root.rglob("*") if path.is_file()), 100)
    )
    return f"there are {some(files)}; describe them with --layout" if files else "the folder is empty"
