"""3D Tiles of a run: its GLB files unchanged, coarse meshes of larger areas, and tilesets over both.

Coarse meshes are made level by level: each from small records of the tiles or meshes below it. A record is a
`Relief` with its image, in a file of the folder ``.coarse``. A worker reads those of one area, so that memory
does not depend on the size of a run, and an interrupted export goes on.
"""

from __future__ import annotations

import io
import json
import math
import zipfile
import zlib
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from hashlib import sha256
from typing import Any

import numpy as np

from flexroad.catalog.ids import safe_name
from flexroad.catalog.storage.paths import Location, exists, listing, parse_location, read, remove, write
from flexroad.catalog.text import count
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.execute import Executor
from flexroad.pipeline.run.finished import FinishedTile
from flexroad.pipeline.store.products import TileProducts
from flexroad.pipeline.worker.exports import GLB, file_name
from flexroad.tasks.meshing.normals import mesh_normals
from flexroad.tasks.products import glb
from flexroad.tools.export import aerial, relief, tiles3d
from flexroad.tools.export.aerial import Aerial
from flexroad.tools.export.georeference import Datum, Ellipsoidal
from flexroad.tools.export.relief import Relief
from flexroad.tools.export.source import Options, Source, TileItem, aerial_of, layer_state, texture_of
from flexroad.tools.export.tile_outputs import ManifestRow, TileOutput, write_outputs

RECORDS, MESHES = ".coarse", "coarse"
"""Folders of records, and of GLB files."""
PREFIX = "coarse_"
"""Start of the ids of coarse meshes, which keeps them apart from those of tiles."""
QUALITY = 85
"""Quality of JPEG images."""
SHARP = 8
"""Geometric error of a mesh in pixels of its image, at least: programs show errors of up to 16 pixels of the
screen (the default of CesiumJS), so that a pixel of the image covers at most two of the screen."""
DAMAGED = (ValueError, KeyError, EOFError, zipfile.BadZipFile, zlib.error)
VERSION = tiles3d.VERSION
NAMED = 5
"""Largest number of tiles that a note names."""


@dataclass(frozen=True)
class Level:
    """How coarse meshes of one size are."""

    side_m: float
    """Side of their areas (m)."""
    spacing_m: float
    """Distance of vertices (m)."""
    pixel_m: float
    """Size of pixels of the image (m)."""


TILE = Level(0.0, 4.0, 2.0)
"""Records of tiles; they are shown only as parts of coarser ones."""
LEVELS = (Level(1000.0, 16.0, 2.0), Level(2000.0, 32.0, 4.0), Level(4000.0, 64.0, 8.0))
"""From fine to coarse; each side is twice the one before."""


@dataclass(frozen=True)
class Place:
    """What the place of a tile's mesh is computed of."""

    run: str
    crs: str
    origin: tuple[float, float]
    datum: Datum

    @property
    def conversion(self) -> Ellipsoidal:
        """From the CRS and the heights of the run to WGS 84."""
        return Ellipsoidal(self.crs, self.datum)


@dataclass(frozen=True)
class Branch:
    """A coarse mesh to be written; sent to a worker."""

    id: str
    level: Level
    cell: tuple[int, int]
    """Column and row of its area, in sides of the finest level."""
    parts: tuple[ManifestRow, ...]
    """Rows of the tiles or coarse meshes that it replaces from afar."""
    folder: str

    @property
    def label(self) -> str:
        """Its name in messages."""
        return f"area {self.id.removeprefix(PREFIX)}"

    @property
    def fingerprint(self) -> str:
        """Name of the mesh by what it is made of."""
        made_of = [(row["record"], row["digest"], row["error_m"], row["photo"]) for row in self.parts]
        return sha256(f"{self.level} {made_of}".encode()).hexdigest()


def record(name: str, ground: Relief, image: Aerial) -> tuple[dict[str, bytes], ManifestRow]:
    """Return a record as file, and the part of a row that refers to it."""
    arrays: Mapping[str, Any] = {
        "bounds": np.array(ground.bounds),
        "heights": ground.heights,
        "cells": ground.cells,
        "error_m": np.float64(ground.error_m),
        "colour": np.rint(image.colour).astype(np.uint8),
        "share": np.rint(image.share * 255).astype(np.uint8),
    }
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)
    data, path = buffer.getvalue(), f"{RECORDS}/{name}.npz"
    return {path: data}, {"record": path, "digest": sha256(data).hexdigest()}


def branch_output(branch: Branch, place: Place) -> TileOutput:
    """Return the GLB file of a coarse mesh, its record, and its row."""
    folder, level = parse_location(branch.folder), branch.level
    parts = [_read(folder, row) for row in branch.parts]
    ground = relief.joined([part for part, _ in parts], level.spacing_m)
    image = aerial.joined([part for _, part in parts], ground.bounds, level.pixel_m)
    # Neighbours of the same level differ by less than twice the error.
    sheet = relief.sheet(ground, max(2 * ground.error_m, level.pixel_m))
    uri = f"{MESHES}/{branch.id.removeprefix(PREFIX)}{glb.NAME}"
    placed, local = tiles3d.sheet_placed(uri, sheet.points, place.conversion)
    photo = any(row["photo"] for row in branch.parts)
    data = relief.encode_sheet(sheet, local, image.bounds, glb.jpeg(image.complete(), QUALITY), photo)
    error_m = max(ground.error_m, SHARP * level.pixel_m, *(row["error_m"] for row in branch.parts))
    files, referred = record(branch.id, ground, image)
    row = row_of(branch.id, branch.cell, placed, error_m, photo) | {"vertical_m": ground.error_m}
    return TileOutput({uri: data, **files}, row | referred)


def row_of(
    name: str, cell: tuple[int, int], placed: dict[str, Any], error_m: float, photo: bool
) -> ManifestRow:
    """Return the row of a tile or coarse mesh, without its record."""
    return {"id": name, "cell": cell, **placed, "error_m": error_m, "photo": photo}


def _read(folder: Location, row: ManifestRow) -> tuple[Relief, Aerial]:
    data = read(folder / row["record"])
    try:
        if sha256(data).hexdigest() != row["digest"]:
            raise ValueError("its checksum differs")
        with np.load(io.BytesIO(data), allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
        west, south, east, north = arrays["bounds"].tolist()
        bounds = west, south, east, north
        ground = Relief(bounds, arrays["heights"], arrays["cells"], float(arrays["error_m"]))
        return ground, Aerial(bounds, arrays["colour"].astype(np.float64), arrays["share"] / 255)
    except DAMAGED as error:
        raise ConfigError(
            f"{folder / row['record']} is damaged ({error}); remove it and export again"
        ) from error


@dataclass(frozen=True, eq=False)
class Node:
    """A tile or a coarse mesh, with what replaces it."""

    row: ManifestRow
    children: tuple[Node, ...] = ()

    def entry(self, parent: Node | None = None) -> dict[str, Any]:
        """Return its entry in the tileset of its block."""
        children = [child.entry(self) for child in self.children]
        extras = {"vertical_error_m": self.row["vertical_m"]} if self.children else {}
        content = self.row | {"uri": f"../{self.row['uri']}"}
        return tiles3d.tile(content, self.row["error_m"], parent.row if parent else None, children, **extras)


def write_tilesets(
    source: Source, tiles: Iterable[FinishedTile], folder: Location, options: Options, executor: Executor
) -> dict[str, Any]:
    """Write the GLB file of each tile, coarse ones, and tilesets: one per block of 4 km, one over the blocks.

    Returns the entry ``notes`` of the manifest: tiles without the orthophoto that was wanted.
    """
    assert options.datum is not None  # the command checks it
    place = Place(str(source.run.path), source.crs, source.origin, options.datum)
    leaves = (_leaf(tile, options.drape) for tile in tiles)
    encode = partial(leaf_output, drape=options.drape)
    nodes = [Node(row) for row in write_outputs(leaves, folder, VERSION, encode, place, executor)]
    nodes.sort(key=lambda node: str(node.row["id"]))
    bare = [node.row["id"] for node in nodes if node.row["bare"]]
    children, written = [], set[str]()
    for block in blocks(nodes, folder, place, executor):
        column, line = _cell(block, len(LEVELS) - 1)
        name, entry = f"blocks/{column}_{line}.json", block.entry()
        volume = entry["boundingVolume"]
        write(folder / name, _encoded(tiles3d.tileset(entry, tiles3d.extent_m(volume["region"]))))
        error_m = block.row["error_m"]
        children.append({"boundingVolume": volume, "geometricError": error_m, "content": {"uri": name}})
        written.add(name)
    for name in listing(folder / "blocks"):
        if f"blocks/{name}" not in written:
            remove(folder / "blocks" / name)
    whole = tiles3d.extent_m(tiles3d.around([child["boundingVolume"]["region"] for child in children]))
    extras = {"crs": source.crs, "datum": options.datum.text}
    tileset = tiles3d.tileset(tiles3d.group(children, whole), whole, **extras)
    write(folder / "tileset.json", _encoded(tileset))
    named = ", ".join(bare[:NAMED]) + (", ..." if len(bare) > NAMED else "")
    note = f"{count(len(bare), 'tile')} without an orthophoto, in plain colours: {named}"
    return {"notes": [note] if bare else []}


def blocks(nodes: Sequence[Node], folder: Location, place: Place, executor: Executor) -> list[Node]:
    """Write the coarse meshes above tiles; return the coarsest, one per area of the last level."""
    raised = list(nodes)
    for number in range(len(LEVELS)):
        raised = _raised(raised, number, folder, place, executor)
    return raised


def _raised(
    nodes: Sequence[Node], number: int, folder: Location, place: Place, executor: Executor
) -> list[Node]:
    """Return the nodes of a level: a coarse mesh per area, or the only node of an area as it is.

    Areas of the last level have a coarse mesh in any case.
    """
    areas: defaultdict[tuple[int, int], list[Node]] = defaultdict(list)
    for node in nodes:
        areas[_cell(node, number)].append(node)
    raised: list[Node] = []
    below: dict[str, tuple[Node, ...]] = {}
    branches: list[Branch] = []
    for cell, parts in sorted(areas.items()):
        if len(parts) == 1 and (parts[0].children or number + 1 < len(LEVELS)):
            raised += parts
            continue
        name = f"{PREFIX}{LEVELS[number].side_m:.0f}_{cell[0]}_{cell[1]}"
        below[name] = tuple(parts)
        rows = tuple(part.row for part in parts)
        branches.append(Branch(name, LEVELS[number], parts[0].row["cell"], rows, str(folder)))
    for row in write_outputs(branches, folder, VERSION, branch_output, place, executor, f"level{number}"):
        raised.append(Node(row, below[row["id"]]))
    return sorted(raised, key=lambda node: _cell(node, number))


def _cell(node: Node, number: int) -> tuple[int, int]:
    """Return column and row of a node's area of a level."""
    column, line = node.row["cell"]
    return column >> number, line >> number


def _leaf(tile: FinishedTile, drape: bool) -> TileItem:
    own, photo = _choice(tile, drape)
    state = layer_state(tile.tile, "dop") if photo else ""
    return TileItem(tile, f"{tile.fingerprint} {tile.snapshot.fingerprint} {own} {state}")


def _choice(tile: FinishedTile, drape: bool) -> tuple[bool, bool]:
    """Return whether the GLB file of the run is taken, if there is one, and whether meshes have the photo."""
    textured = tile.place.pattern.export.texture
    return textured or not drape, textured or drape


def leaf_output(leaf: TileItem, place: Place, drape: bool) -> TileOutput:
    """Return the GLB file of a tile, a record for coarse meshes, and its row.

    With ``drape`` its mesh has the orthophoto, even if that of the run has none.
    """
    tile = leaf.tile
    own, draped = _choice(tile, drape)
    mesh, grid, texture = tile.mesh, tile.tile.grid, texture_of(tile) if draped else None
    points = mesh.vertices + mesh.origin
    heights = float(points[:, 2].min()), float(points[:, 2].max())
    name = safe_name(tile.id)
    uri = f"tiles/{name}{glb.NAME}"
    placed = tiles3d.placed(uri, grid.bounds, heights, place.origin, place.conversion)
    pixel_m = TILE.pixel_m
    ground = relief.of_mesh(points, relief.highest_first(mesh), TILE.spacing_m)
    colours = glb.ROAD_SRGB, glb.TERRAIN_SRGB
    image = aerial.of_classes(points, mesh.faces, mesh.road, colours, ground.bounds, pixel_m)
    if texture:
        photo = aerial.joined([aerial_of(texture, pixel_m)], ground.bounds, pixel_m)
        image = replace(photo, share=image.share)
    files, referred = record(name, ground, image)
    side = LEVELS[0].side_m
    west, south, east, north = grid.bounds
    cell = math.floor((west + east) / 2 / side), math.floor((south + north) / 2 / side)
    row = row_of(tile.id, cell, placed, 0.0, bool(texture)) | {"bare": draped and not texture}
    return TileOutput({uri: _glb(tile, own, place, texture), **files}, row | referred)


def _glb(tile: FinishedTile, own: bool, place: Place, texture: glb.Texture | None) -> bytes:
    """Return the GLB file of the run, or a new one if the run has none that fits."""
    file = TileProducts.of(parse_location(place.run), tile.id).file(file_name(tile.id, tile.variant, GLB))
    if (own or not texture) and exists(file):
        data = read(file)
        tile.check_unchanged()
        return data
    normals = mesh_normals(tile.mesh, tile.surface)
    return glb.encode(tile.mesh, (*place.origin, 0.0), texture, normals, tile.id)


def _encoded(content: dict[str, Any]) -> bytes:
    return json.dumps(content, separators=(",", ":"), allow_nan=False).encode()
