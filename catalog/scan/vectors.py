"""Vector files of roads, and the tiles that they reach."""

from __future__ import annotations

import math
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import shapely

from flexroad.catalog.crs import bounds_in, transformer
from flexroad.catalog.crs_checks import angle_fault, crs_of, elsewhere
from flexroad.catalog.errors import CatalogError
from flexroad.catalog.grid import Bounds, union
from flexroad.catalog.guard.open_vector import ERRORS, layer_info, vector_name
from flexroad.catalog.guard.source_files import InputRejected
from flexroad.catalog.guard.vector_contents import real_bounds
from flexroad.catalog.lazy import lazy
from flexroad.catalog.scan.rasters import matching, name_below
from flexroad.catalog.skipped import Skipped
from flexroad.catalog.text import access_reason, count, reason
from flexroad.catalog.tile import REACH_M, RECENT, Layer, Tile

pyogrio = lazy("pyogrio")

LAYER_NAME = "|layername="
MARGIN_M = 1.0
"""Extents are larger than the features' bounds by this much (m): the bounds of a straight road are empty."""
EVERYWHERE: Bounds = (-1e9, -1e9, 1e9, 1e9)
"""Extent of a file that may have features anywhere (m)."""
NOWHERE: Bounds = (math.inf, math.inf, 0.0, 0.0)
"""Extent of a file without features, or with features that have no place in the tiles' CRS."""


@dataclass(frozen=True)
class VectorFile:
    """The header of a vector file."""

    path: Path
    """Absolute."""
    has_crs: bool
    """False if the file has no CRS or a wrong CRS, so that the CRS of the caller is used."""
    extents: tuple[tuple[str, Bounds], ...] | None
    """CRS and bounds of each layer with features, or None if the format does not store them."""
    sublayer: str | None = None
    """The layer of the roads, if it was chosen."""


def file_and_layer(given: Path | str) -> tuple[Path, str | None]:
    """Split ``FILE|layername=NAME``, as QGIS writes it; the layer is None without a name."""
    file, named, layer = str(given).partition(LAYER_NAME)
    return Path(file), layer if named else None


def find(root: Path, given: str, crs: str | None) -> tuple[list[VectorFile], list[Skipped]]:
    """Open vector files; return the usable ones, and the others.

    - `given`: a file, or a glob pattern relative to ``root``; with a layer as in `file_and_layer`.
    """
    root = root.resolve()
    file, sublayer = file_and_layer(given)
    paths, unlisted = ([file], []) if file.is_file() else matching(root, "roads", str(file))
    files, errors = list[VectorFile](), dict[Path, CatalogError]()
    for path in paths:
        try:
            files.append(opened(path, crs, sublayer))
        except CatalogError as error:
            errors[path] = error
    if not files:
        raise next(iter(errors.values()))
    skipped = (Skipped(str(path.absolute()), "", str(error)) for path, error in errors.items())
    return files, [*skipped, *unlisted]


def layers(path: Path) -> dict[str, str]:
    """Return the layers with geometries of a vector file, each with its type and number of features."""
    file = vector_name(path)
    kinds = {name: kind for name, kind in pyogrio.list_layers(file) if kind is not None}
    counts = {name: layer_info(file, name)["features"] for name in kinds}
    # OSM files do not know their number of features.
    return {
        name: f"{kind}, {count(counts[name], 'feature')}" if counts[name] >= 0 else kind
        for name, kind in kinds.items()
    }


def listed(found: Mapping[str, str]) -> str:
    """Return the layers of a vector file for a message: ``roads (LineString, 12 features), ...``."""
    return ", ".join(f"{name} ({about})" for name, about in found.items())


def several(subject: str, path: Path, found: Mapping[str, str]) -> CatalogError:
    """Return the error that the layer of a file must be named; ``subject`` begins its message."""
    example = shlex.quote(f"{path}{LAYER_NAME}{next(iter(found))}")
    return CatalogError(
        f"{subject} has {count(len(found), 'layer')}: {listed(found)}; name one, such as {example}"
    )


def one_layer(subject: str, path: Path, layer: str | None) -> str | None:
    """Return the layer to read: the named one, else the only one, or None if the file has no layer."""
    found = layers(path)
    if layer is None and len(found) > 1:
        raise several(subject, path, found)
    if layer is not None and layer not in found:
        raise CatalogError(f"{subject} has no layer {layer!r}; it has {listed(found) or 'none'}")
    return layer or next(iter(found), None)


def opened(path: Path, crs: str | None, sublayer: str | None = None) -> VectorFile:
    """Open one vector file; see `find`."""
    try:
        file = vector_name(path)
        found = layers(path)
        names = [name for name in found if sublayer in (None, name)]
        infos = [layer_info(file, name) for name in names]
        # The bounds of an OSM file are known only after reading all of it.
        no_bounds = any(info["driver"] == "OSM" for info in infos)
        if not no_bounds:
            infos = [layer_info(file, name, force_total_bounds=True) for name in names]
            infos = [info | {"total_bounds": real_bounds(file, info)} for info in infos]
    except InputRejected as error:
        raise CatalogError(f"--roads {path} {error}") from error
    except ERRORS as error:
        if why := access_reason(error):
            raise CatalogError(f"--roads {path} {why}") from error
        raise CatalogError(f"--roads {path} is not a vector file: {reason(error)}") from error
    if found and not names:
        raise CatalogError(f"--roads {path} has no layer {sublayer!r}; it has {listed(found)}")
    if len(names) > 1 and not no_bounds:
        raise several(f"--roads {path}", path, found)
    if not infos:
        raise CatalogError(f"--roads {path} is not a vector file: it has no layer with geometries")
    systems = [_system(path, info, crs) for info in infos]
    has_crs = [info["crs"] for info in infos] == systems
    # An empty layer has no bounds.
    extents = tuple(
        (system, tuple(info["total_bounds"]))
        for info, system in zip(infos, systems, strict=True)
        if info["total_bounds"] is not None
    )
    return VectorFile(path.resolve(), has_crs, None if no_bounds else extents, sublayer)


def _system(path: Path, info: Mapping[str, Any], given: str | None) -> str:
    """Return the CRS of an opened layer; see `crs_of`."""
    bounds = bounds_of(info)
    system = crs_of(info["crs"], given, bounds)
    if system is None:
        raise CatalogError(
            f"--roads {path} has no CRS; give it with --crs, or add it to the file with ogr2ogr -a_srs"
        )
    if angles := angle_fault(system, bounds):
        raise CatalogError(
            f"--roads {path} {angles}; give its CRS with --crs, or add it to the file with ogr2ogr -a_srs"
        )
    return system


def bounds_of(info: Mapping[str, Any]) -> Bounds:
    """Return the bounds of an opened layer (pyogrio's), NaN if they are unknown or it has no feature."""
    bounds = info["total_bounds"]
    return (math.nan,) * 4 if bounds is None else tuple(bounds)


def with_roads(
    tiles: Sequence[Tile], files: Sequence[VectorFile], crs: str | None
) -> tuple[tuple[Tile, ...], list[Skipped]]:
    """Return the tiles with a layer ``roads`` of the files within `REACH_M`, and the files far from all."""
    if not files:
        return tuple(tiles), []
    extents = {
        target: np.array([_extent(file, target) for file in files])
        for target in {tile.grid.crs for tile in tiles}
    }
    # The tree saves time: a survey of a state has as many files as tiles.
    trees = {}
    for target, bounds in extents.items():
        boxes = np.full(len(bounds), None, object)
        # A file that reaches no ground has None.
        known = np.isfinite(bounds).all(axis=1)
        boxes[known] = shapely.box(*bounds[known].T)
        trees[target] = shapely.STRtree(boxes)
    near = [
        np.sort(trees[tile.grid.crs].query(shapely.box(*tile.grid.buffered(REACH_M).bounds)))
        for tile in tiles
    ]
    reached = np.bincount(np.concatenate(near), minlength=len(files))
    far = [
        Skipped(str(file.path), "", f"--roads {file.path} {_far(file, tiles)}")
        for file, number in zip(files, reached, strict=True)
        if not number
    ]
    if len(far) == len(files):
        raise CatalogError(far[0].reason)
    # The CRS of the complete layer is used, so that all tiles describe the layer in the same way.
    bare = None if all(file.has_crs for file in files) else crs

    @lru_cache(RECENT)
    def layer(numbers: tuple[int, ...], target: str, root: Path) -> Layer:
        """Return the layer of files given by their numbers; neighbouring tiles share it."""
        chosen = [files[number] for number in numbers]
        names = tuple(name_below(root, file.path) for file in chosen)
        bounds = tuple(map(tuple, extents[target][list(numbers)].tolist()))
        return Layer("roads", names, crs=bare, extents=bounds, sublayer=chosen[0].sublayer)

    with_layer = (
        replace(tile, layers=(*tile.layers, layer(tuple(numbers.tolist()), tile.grid.crs, Path(tile.root))))
        if numbers.size
        else tile
        for tile, numbers in zip(tiles, near, strict=True)
    )
    return tuple(with_layer), far


def _far(file: VectorFile, tiles: Sequence[Tile]) -> str:
    """Return the message that a file reaches no tile, with the places of both."""
    text = "reaches no tile; check its CRS and its extent"
    if not file.extents:
        return text
    target = tiles[0].grid.crs
    ground = union([tile.grid.bounds for tile in tiles if tile.grid.crs == target])
    return f"{text}: it {elsewhere(*file.extents[0], target, ground, REACH_M)}"


def _extent(file: VectorFile, target: str) -> Bounds:
    """Return the extent of a file in a CRS (m): all of the ground if its bounds are unknown there."""
    if file.extents is None:
        return EVERYWHERE
    placed = [_placed(crs, target, bounds) for crs, bounds in file.extents]
    west, south, east, north = union(placed or [NOWHERE])
    return west - MARGIN_M, south - MARGIN_M, east + MARGIN_M, north + MARGIN_M


def _placed(crs: str, target: str, bounds: Bounds) -> Bounds:
    placed = bounds_in(target, crs, bounds)
    if np.isfinite(placed).all():
        return placed
    west, south, east, north = bounds
    corners = transformer(crs, target).transform((west, east, west, east), (south, south, north, north))
    return EVERYWHERE if np.isfinite(corners).all(axis=0).any() else NOWHERE
