"""3D Tiles of a run: its GLB files unchanged, coarse meshes of larger areas, and tilesets over both."""

from __future__ import annotations

import json
import math
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

from flexroad.catalog.ids import safe_name
from flexroad.catalog.storage.paths import Location, exists, listing, parse_location, read, remove, write
from flexroad.catalog.text import count
from flexroad.pipeline.execute import Executor
from flexroad.pipeline.export import coarse
from flexroad.pipeline.export.coarse import LEVELS, Branch, Place, branch_piece
from flexroad.pipeline.export.options import Options
from flexroad.pipeline.export.photo import aerial_of, texture_of
from flexroad.pipeline.export.pieces import Piece, Row, write_pieces
from flexroad.pipeline.export.source import OfTile, Source, layer_state
from flexroad.pipeline.run.finished import FinishedTile
from flexroad.pipeline.store.products import TileProducts
from flexroad.pipeline.worker.exports import GLB, file_name
from flexroad.pipeline.worker.texture import TileTexture
from flexroad.tasks.export import glb, tiles3d
from flexroad.tasks.meshing import aerial, relief

VERSION = tiles3d.VERSION
NAMED = 5
"""Largest number of tiles that a note names."""


@dataclass(frozen=True, eq=False)
class Leaf(OfTile):
    """A finished tile whose mesh is placed on the Earth."""

    drape: bool
    """Whether its mesh is to have the orthophoto, even if that of the run has none."""

    @property
    def own(self) -> bool:
        """Whether the GLB file of the run is taken, if there is one."""
        return self.tile.place.pattern.export.texture or not self.drape

    @property
    def photo(self) -> bool:
        """Whether its mesh has the orthophoto, if there is one."""
        return self.drape or self.tile.place.pattern.export.texture

    @property
    def fingerprint(self) -> str:
        """Name of its files by what they are made of."""
        photo = layer_state(self.tile.tile, "dop") if self.photo else ""
        return f"{self.tile.fingerprint} {self.tile.snapshot.fingerprint} {self.own} {photo}"


@dataclass(frozen=True, eq=False)
class Node:
    """A tile or a coarse mesh, with what replaces it."""

    row: Row
    children: tuple[Node, ...] = ()

    def entry(self, parent: Node | None = None) -> dict[str, Any]:
        """Return its entry in the tileset of its block."""
        children = [child.entry(self) for child in self.children]
        extras = {"vertical_error_m": self.row["vertical_m"]} if self.children else {}
        outer = parent._placed if parent else None
        return tiles3d.tile(self._placed, self.row["error_m"], outer, children, **extras)

    @property
    def _placed(self) -> tiles3d.Placed:
        row = self.row
        return tiles3d.Placed(f"../{row['uri']}", tuple(row["transform"]), tuple(row["region"]), 0.0)


def write_tilesets(
    source: Source, tiles: Iterable[FinishedTile], folder: Location, options: Options, executor: Executor
) -> dict[str, Any]:
    """Write the GLB file of each tile, coarse ones, and tilesets: one per block of 4 km, one over the blocks.

    Returns the entry ``notes`` of the manifest: tiles without the orthophoto that was wanted.
    """
    assert options.datum is not None  # the command checks it
    place = Place(str(source.run.path), source.crs, source.origin, options.datum)
    leaves = (Leaf(tile, options.drape) for tile in tiles)
    nodes = [Node(row) for row in write_pieces(leaves, folder, VERSION, leaf_piece, place, executor)]
    nodes.sort(key=lambda node: str(node.row["id"]))
    bare = [node.row["id"] for node in nodes if node.row["bare"]]
    children, named = [], set[str]()
    for block in blocks(nodes, folder, place, executor):
        column, line = _cell(block, len(LEVELS) - 1)
        name, entry = f"blocks/{column}_{line}.json", block.entry()
        volume = entry["boundingVolume"]
        write(folder / name, _encoded(tiles3d.tileset(entry, tiles3d.extent_m(volume["region"]))))
        error_m = block.row["error_m"]
        children.append({"boundingVolume": volume, "geometricError": error_m, "content": {"uri": name}})
        named.add(name)
    for name in listing(folder / "blocks"):
        if f"blocks/{name}" not in named:
            remove(folder / "blocks" / name)
    whole = tiles3d.extent_m(tiles3d.around([child["boundingVolume"]["region"] for child in children]))
    extras = {"crs": source.crs, "datum": options.datum.text}
    tileset = tiles3d.tileset(tiles3d.group(children, whole), whole, **extras)
    write(folder / "tileset.json", _encoded(tileset))
    return {"notes": [_without_photo(bare)] if bare else []}


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
        name = f"{coarse.PREFIX}{LEVELS[number].side_m:.0f}_{cell[0]}_{cell[1]}"
        below[name] = tuple(parts)
        rows = tuple(part.row for part in parts)
        branches.append(Branch(name, LEVELS[number], parts[0].row["cell"], rows, str(folder)))
    for row in write_pieces(branches, folder, VERSION, branch_piece, place, executor, f"level{number}"):
        raised.append(Node(row, below[row["id"]]))
    return sorted(raised, key=lambda node: _cell(node, number))


def _cell(node: Node, number: int) -> tuple[int, int]:
    """Return column and row of a node's area of a level."""
    column, line = node.row["cell"]
    return column >> number, line >> number


def leaf_piece(leaf: Leaf, place: Place) -> Piece:
    """Return the GLB file of a tile, a record for coarse meshes, and its row."""
    tile = leaf.tile
    mesh, grid, texture = tile.mesh, tile.tile.grid, texture_of(tile) if leaf.photo else TileTexture()
    points = mesh.vertices + mesh.origin
    heights = float(points[:, 2].min()), float(points[:, 2].max())
    name = safe_name(tile.id)
    uri = f"tiles/{name}{glb.NAME}"
    placed = tiles3d.placed(uri, grid.bounds, heights, place.origin, place.conversion)
    pixel_m = coarse.TILE.pixel_m
    ground = relief.of_mesh(points, mesh.faces, coarse.TILE.spacing_m)
    colours = glb.ROAD_SRGB, glb.TERRAIN_SRGB
    image = aerial.of_classes(points, mesh.faces, mesh.road, colours, ground.bounds, pixel_m)
    if texture.image:
        photo = aerial.joined([aerial_of(texture.image, pixel_m)], ground.bounds, pixel_m)
        image = replace(photo, share=image.share)
    files, referred = coarse.record(name, ground, image)
    side = LEVELS[0].side_m
    west, south, east, north = grid.bounds
    cell = math.floor((west + east) / 2 / side), math.floor((south + north) / 2 / side)
    row = coarse.row_of(tile.id, cell, placed, 0.0) | {"bare": leaf.photo and not texture.image}
    return Piece({uri: _glb(leaf, place, texture), **files}, row | referred)


def _glb(leaf: Leaf, place: Place, texture: TileTexture) -> bytes:
    """Return the GLB file of the run, or a new one if the run has none that fits."""
    tile = leaf.tile
    file = TileProducts.of(parse_location(place.run), tile.id).file(file_name(tile.id, tile.variant, GLB))
    if (leaf.own or not texture.image) and exists(file):
        data = read(file)
        tile.check_unchanged()
        return data
    return glb.encode(tile.mesh, (*place.origin, 0.0), texture.image, tile.surface)


def _without_photo(ids: Sequence[str]) -> str:
    named = ", ".join(ids[:NAMED]) + (", ..." if len(ids) > NAMED else "")
    return f"{count(len(ids), 'tile')} without an orthophoto, in plain colours: {named}"


def _encoded(content: dict[str, Any]) -> bytes:
    return json.dumps(content, separators=(",", ":"), allow_nan=False).encode()
