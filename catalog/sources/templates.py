"""Folders with one file per tile and layer, described by templates such as ``{stratum}/{tile}/dsm.tif``.

A template is a path relative to the folder. ``{tile}`` is the tile's id, ``{stratum}`` its class of area, and
``*`` any text; none of them matches a slash.

The paper's datasets are read so: GeRoD, 240 tiles of 250 x 250 m of North Rhine-Westphalia, and DSC3D, the
DeepScenario Open 3D Dataset, as rasters made from the meshes of its scenes with separate true heights. The
names of their files are not fixed: without templates the files of GeRoD are found by the words in their paths
(`catalog.layouts`). The templates in ``configs/dsc3d.yaml`` are a guess and must be adapted to the folder.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

from flexroad.catalog import layouts
from flexroad.catalog.derived import is_current, rasters_of_points, write_heights
from flexroad.catalog.errors import CatalogError
from flexroad.catalog.grid import Grid
from flexroad.catalog.scan.rasters import RasterFile, glob, opened, require_metric, there, unlisted_folders
from flexroad.catalog.skipped import Skipped, lines
from flexroad.catalog.text import shown, some
from flexroad.catalog.tile import LAYERS, Layer, Tile
from flexroad.catalog.tiling import MASKS, TilingResult, assumed, taken

GEROD, DSC3D = "GeRoD", "DSC3D"
GEROD_CRS = "EPSG:25832"
CORNER = re.compile(r"(\d+)_(\d+)")
"""Ids of GeRoD are the south-west corner in whole metres: the paper's ``295500_5629250``."""
NEEDED = ("dsm", "dtm")
PLACEHOLDER = re.compile(r"\{(.*?)\}")


@dataclass(frozen=True)
class Layout:
    """Paths of a dataset's files, and properties that the files do not declare."""

    layers: Mapping[str, str]
    """Template by layer (see `catalog.LAYERS`)."""
    road_values: tuple[int, ...] = ()
    """Cell values that mean road in the masks; empty: every value but 0 and nodata."""
    crs: str | None = None
    """CRS of files without one."""

    def __post_init__(self) -> None:
        for name, template in self.layers.items():
            if name not in LAYERS:
                raise CatalogError(f"layout: unknown layer {shown(name)}; layers are {', '.join(LAYERS)}")
            names = PLACEHOLDER.findall(template)
            if "tile" not in names or not set(names) <= {"tile", "stratum"}:
                raise CatalogError(
                    f"layout: {name}: {shown(template)} needs {{tile}} and may have {{stratum}} and *, "
                    "no others"
                )
        for name in NEEDED:
            if name not in self.layers:
                raise CatalogError(f"layout: no template for {name}; a tile needs {' and '.join(NEEDED)}")

    @classmethod
    def of(cls, raw: Mapping[str, Any]) -> Layout:
        """Return the layout of a configuration's ``dataset`` section."""
        kinds = {
            "layers": (dict, "a mapping of layers to templates"),
            "crs": (str, "a CRS such as EPSG:25832"),
            "road_values": (list, "a list of whole numbers"),
        }
        for key, value in raw.items():
            if key not in kinds:
                raise CatalogError(f"layout: unknown key {shown(key)}; keys are {', '.join(kinds)}")
            if not isinstance(value, kinds[key][0]):
                raise CatalogError(f"layout: {key}: expected {kinds[key][1]}, not {shown(value)}")
        if not all(isinstance(template, str) for template in raw.get("layers", {}).values()):
            raise CatalogError(
                f"layout: layers: every template must be text, not as in {shown(raw['layers'])}"
            )
        if not all(isinstance(value, int) for value in raw.get("road_values", [])):
            raise CatalogError(
                f"layout: road_values: expected whole numbers, not {shown(raw['road_values'])}"
            )
        return cls(raw.get("layers", {}), tuple(raw.get("road_values", ())), raw.get("crs"))


class _MatchedFile(NamedTuple):
    file: RasterFile
    stratum: str
    """Read from its path."""


_ByLayer = dict[str, dict[str, _MatchedFile]]


def index(
    root: Path, layout: Mapping[str, Any], dataset: str, *, derived: Path | None = None
) -> TilingResult:
    """Return the tiles of a dataset's folder, with notes on what differs from the paper's.

    A tile's grid is that of its DSM file.

    Parameters
    ----------
    root : Path
        The folder.
    layout : Mapping[str, Any]
        ``layers`` (templates), ``road_values`` and ``crs``, as in a configuration's ``dataset``; see
        `by_name`.
    dataset : str
        `GEROD` or `DSC3D`.
    derived : Path, optional
        Folder for rasters of points (``.npz``), which are left out without it.

    Raises
    ------
    CatalogError
        If the layout is invalid, there is no usable DSM in metres, or two files are the same layer of a tile.
    """
    named = dataset == GEROD and by_name(layout)
    paths = Layout.of({"layers": dict.fromkeys(NEEDED, "{tile}"), **layout} if named else layout)
    if not root.is_dir():
        raise CatalogError(f"folder {root} does not exist")
    root = root.resolve()
    by_layer, notes, left_out = _named(root, paths, derived) if named else _by_templates(root, paths)
    if not by_layer.get("dsm"):
        why = lines(left_out)[0] if left_out else there(root, "; describe them with --layout")
        meant = f"matches {paths.layers['dsm']!r} (dsm)"
        if named:
            meant = f"is the dsm of a tile such as {layouts.NAMED[0]}"
        raise CatalogError(f"no usable file {meant} below {root}; {why}")
    left_out += _without_metres(root, by_layer["dsm"])
    tiles = tuple(
        _tile(
            root,
            tile_id,
            {name: of[tile_id] for name, of in by_layer.items() if tile_id in of},
            paths,
            dataset,
        )
        for tile_id in sorted(by_layer["dsm"])
    )
    for name in () if named else paths.layers:
        if lacking := [tile.id for tile in tiles if tile.layer(name) is None]:
            share = f"{len(lacking)} of {len(tiles)} tiles"
            notes.append(f"no {name} at {paths.layers[name]!r} for {share}: {some(lacking)}")
    own = {GEROD: _gerod_notes, DSC3D: _dsc3d_notes}[dataset](tiles)
    return TilingResult(tiles, (*notes, *assumed(tiles), *own), tuple(left_out))


def by_name(layout: Mapping[str, Any]) -> bool:
    """Return whether the files of GeRoD are found by their names: the layout has no templates."""
    return bool(layout) and "layers" not in layout


def _gerod_notes(tiles: Sequence[Tile]) -> list[str]:
    """Return notes on tiles that are not at the corner in their id (a wrong template or CRS) or missing."""
    off = []
    for tile in tiles:
        corner, (west, south) = CORNER.fullmatch(tile.id), tile.grid.bounds[:2]
        # Some programs write rasters of points, which begin half a cell before the corner.
        if not corner or math.dist(map(float, corner.groups()), (west, south)) > tile.grid.cell:
            off.append(tile.id)
    notes = [f"not at the corner given by the tile's name: {some(off)}; check layout and CRS"] if off else []
    if len(tiles) != layouts.TILES:
        notes.append(f"{len(tiles)} of the dataset's {layouts.TILES} tiles are here")
    return notes


def _dsc3d_notes(tiles: Sequence[Tile]) -> list[str]:
    # The paper's reference takes roads from the filtered DSM and terrain from the refined DTM.
    without = [tile.id for tile in tiles if tile.layer("reference") is None]
    note = f"no reference for {some(without)}: the DTM is used instead, unlike in the paper"
    return [note] if without else []


def _by_templates(root: Path, layout: Layout) -> tuple[_ByLayer, list[str], list[Skipped]]:
    """Return the files that match the templates by layer and tile id, notes, and what is left out."""
    by_layer, left_out = _ByLayer(), list[Skipped]()
    for name in (name for name in LAYERS if name in layout.layers):
        by_layer[name], skipped = _files(root, name, layout)
        left_out += skipped
    return by_layer, [], left_out


def _named(root: Path, layout: Layout, derived: Path | None) -> tuple[_ByLayer, list[str], list[Skipped]]:
    """Return the files of GeRoD, found by their names, as `_by_templates` does."""
    found, notes = layouts.find(root)
    paths, left_out = _rasters(root, found, derived, layout.crs or GEROD_CRS)
    by_layer = _ByLayer()
    for name in (name for name in LAYERS if any(file.layer == name for file in paths.values())):
        parts = {path: (file.tile, file.stratum) for path, file in paths.items() if file.layer == name}
        by_layer[name], skipped = _opened(root, name, parts, layout.crs, "leave one of them")
        left_out += skipped
    return by_layer, notes, left_out


def _rasters(
    root: Path, found: Sequence[layouts.Found], derived: Path | None, crs: str
) -> tuple[dict[Path, layouts.Found], list[Skipped]]:
    """Return the rasters, also rasters made from points, and the point files that are left out."""
    paths, left_out = dict[Path, layouts.Found](), list[Skipped]()
    for file in found:
        if not file.name.lower().endswith(layouts.POINTS):
            paths[root / file.name] = file
        elif derived is None:
            reason = "points need a folder for their rasters"
            left_out.append(Skipped(file.name, file.layer, reason, str(root)))
        else:
            try:
                paths |= _of_points(root / file.name, file, derived.resolve(), crs)
            except CatalogError as error:
                left_out.append(Skipped(file.name, file.layer, str(error), str(root)))
    return paths, left_out


def _of_points(source: Path, file: layouts.Found, derived: Path, crs: str) -> dict[Path, layouts.Found]:
    """Write the arrays of points as rasters, once per file; return the rasters."""
    folder = derived / file.tile
    made = {path: path.stem.rpartition(".")[2] for path in sorted(folder.glob(f"{source.stem}.*.tif"))}
    if not made or not all(is_current(source, path) for path in made):
        east, north = map(float, file.tile.split("_"))
        rasters, transform = rasters_of_points(source, (east, north))
        made = {}
        for name, heights in rasters.items():
            layer = file.layer if name == "z" else layouts.layer_of(name, layouts.OWN_NAMES)
            if layer in LAYERS:
                made[path := folder / f"{source.stem}.{layer}.tif"] = layer
                write_heights(path, heights, transform, crs)
    return {path: replace(file, layer=layer) for path, layer in made.items()}


def _without_metres(root: Path, dsm: dict[str, _MatchedFile]) -> list[Skipped]:
    """Remove the files that are not in metres, and return them; raise an error if no file remains."""
    errors = dict[str, CatalogError]()
    for tile_id, match in dsm.items():
        try:
            require_metric(match.file)
        except CatalogError as error:
            errors[tile_id] = error
    if len(errors) == len(dsm):
        raise next(iter(errors.values()))
    return [
        Skipped(dsm.pop(tile_id).file.name, "", str(error), str(root)) for tile_id, error in errors.items()
    ]


def _files(root: Path, layer: str, layout: Layout) -> tuple[dict[str, _MatchedFile], list[Skipped]]:
    """Return the files of a layer by tile id, and skipped files and folders."""
    template = layout.layers[layer]
    pattern = _pattern(template)
    try:
        paths, unlisted = glob(root, PLACEHOLDER.sub("*", template))
    except (ValueError, NotImplementedError) as error:
        raise CatalogError(f"layout: {layer}: {template!r} is not a path below {root}: {error}") from error
    parts = {
        path: (match["tile"], match.groupdict().get("stratum") or "")
        for path in paths
        if (match := pattern.fullmatch(path.relative_to(root).as_posix()))
    }
    remedy = f"change the template {template!r} so that it matches only one of them"
    by_tile, skipped = _opened(root, layer, parts, layout.crs, remedy)
    return by_tile, [*skipped, *unlisted_folders(root, layer, unlisted)]


def _opened(
    root: Path, layer: str, parts: Mapping[Path, tuple[str, str]], crs: str | None, remedy: str
) -> tuple[dict[str, _MatchedFile], list[Skipped]]:
    """Return the files of a layer by tile id, and skipped files.

    ``parts`` gives id and stratum of each path, ``remedy`` the advice for two files of a tile.
    """
    files, skipped = opened(root, layer, parts, crs)
    by_tile: dict[str, _MatchedFile] = {}
    for file in files:
        tile_id, stratum = parts[root / file.name]
        if tile_id in by_tile:
            raise CatalogError(
                f"{by_tile[tile_id].file.name} and {file.name} are both the {layer} of tile {tile_id}; "
                f"{remedy}"
            )
        by_tile[tile_id] = _MatchedFile(file, stratum)
    return by_tile, skipped


def _pattern(template: str) -> re.Pattern[str]:
    """Return a regular expression with groups for the tile's id and stratum."""
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
    root: Path,
    tile_id: str,
    files: Mapping[str, _MatchedFile],
    layout: Layout,
    dataset: str,
) -> Tile:
    dsm = files["dsm"].file
    layers = tuple(
        Layer(
            name,
            (match.file.name,),
            layout.road_values if name in MASKS else (),
            None if match.file.has_crs else layout.crs,
        )
        for name, match in files.items()
    )
    stratum = next((match.stratum for match in files.values() if match.stratum), "")
    grid = Grid.covering(dsm.crs, dsm.bounds, dsm.cell)
    return Tile(tile_id, grid, layers, str(root), *taken([dsm]), stratum=stratum, dataset=dataset)
