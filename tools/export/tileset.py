"""3D Tiles of a run: its unchanged GLB files, coarse meshes of larger areas, and tilesets over both.

Coarse meshes are made level by level, each from small records of the tiles or meshes below it. A record is a
`Relief` with its image, in a file of the folder ``.coarse``. A worker reads the records of one area. So
memory does not depend on the size of a run, and an interrupted export can continue.
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
import scipy
from numpy.typing import NDArray

from flexroad.catalog.grid import Bounds
from flexroad.catalog.ids import safe_name
from flexroad.catalog.lazy import lazy
from flexroad.catalog.storage.paths import Location, exists, listing, parse_location, read, remove, write
from flexroad.catalog.text import count
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.execute import Executor
from flexroad.pipeline.run.finished import FinishedTile
from flexroad.pipeline.store.products import TileProducts
from flexroad.pipeline.worker.exports import GLB, file_name
from flexroad.tasks.meshing.normals import mesh_normals
from flexroad.tasks.metrics.mesh_distance import at_nodes
from flexroad.tasks.products import glb
from flexroad.tasks.types import Bools, Floats
from flexroad.tools.export import relief, tiles3d
from flexroad.tools.export.georeference import Datum, Georeference
from flexroad.tools.export.relief import Relief
from flexroad.tools.export.source import Options, Source, layer_state, texture_of
from flexroad.tools.export.tile_outputs import ManifestRow, TileOutput, write_outputs

Image = lazy("PIL.Image")

RECORDS, MESHES = ".coarse", "coarse"
"""Folders of records and of GLB files."""
PREFIX = "coarse_"
"""Start of the ids of coarse meshes, so that they differ from the ids of tiles."""
QUALITY = 85
"""Quality of JPEG images."""
SHARP = 8
"""Least geometric error of a mesh in pixels of its image. Programs accept errors of up to 16 pixels of the
screen (the default of CesiumJS). So a pixel of the image covers at most two pixels of the screen."""
DAMAGED = (ValueError, KeyError, EOFError, zipfile.BadZipFile, zlib.error)
VERSION = tiles3d.VERSION
NAMED = 5
"""Largest number of tiles that a note names."""


TILE_M = 4.0, 2.0
"""Distance of vertices and size of pixels in the records of tiles (m)."""
LEVELS_M = ((1000.0, 16.0, 2.0), (2000.0, 32.0, 4.0), (4000.0, 64.0, 8.0))
"""Side of the areas, distance of vertices, size of pixels of coarse meshes (m); each side is doubled."""
SAMPLES = 4
"""A pixel of `of_classes` is the mean of this number of places from west to east and from north to south."""

Place = tuple[Georeference, Datum]
"""Origin of the run's coordinates, and conversion of its heights to heights above the ellipsoid."""


@dataclass(frozen=True)
class Branch:
    """A coarse mesh to be written; sent to a worker."""

    id: str
    level: int
    """Index in `LEVELS_M`."""
    cell: tuple[int, int]
    """Column and row of its area, in areas of the finest level."""
    parts: tuple[ManifestRow, ...]
    """Rows of the tiles or coarse meshes that it replaces in distant views."""
    folder: str

    @property
    def label(self) -> str:
        """Its name in messages."""
        return f"area {self.id.removeprefix(PREFIX)}"

    @property
    def fingerprint(self) -> str:
        """Hash of the records from which the mesh is made."""
        made_of = [(row["record"], row["digest"], row["error_m"], row["photo"]) for row in self.parts]
        return sha256(f"{LEVELS_M[self.level]} {made_of}".encode()).hexdigest()


def record(name: str, ground: Relief, image: Aerial) -> tuple[dict[str, bytes], ManifestRow]:
    """Return a record as a file, and the entries of a row that refer to it."""
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
    folder, (_, spacing_m, pixel_m) = parse_location(branch.folder), LEVELS_M[branch.level]
    grounds, images = zip(*(_read(folder, row) for row in branch.parts), strict=True)
    ground = relief.joined(grounds, spacing_m)
    image = joined(images, ground.bounds, pixel_m)
    # Neighbours of the same level differ by less than twice the error.
    sheet = relief.sheet(ground, max(2 * ground.error_m, pixel_m))
    uri = f"{MESHES}/{branch.id.removeprefix(PREFIX)}{glb.NAME}"
    (georeference, datum), points = place, sheet.points
    placed, local = tiles3d.sheet_placed(uri, points, georeference.crs, datum)
    photo = any(row["photo"] for row in branch.parts)
    data = relief.encode_sheet(sheet, local, image.bounds, glb.jpeg(image.complete(), QUALITY), photo)
    error_m = max(ground.error_m, SHARP * pixel_m, *(row["error_m"] for row in branch.parts))
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
    """A tile or a coarse mesh, with the nodes that replace it in close views."""

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
    """Write the GLB files of tiles and coarse meshes, a tileset per block of 4 km, and one over all blocks.

    Returns the entry ``notes`` of the manifest: tiles that lack the requested orthophoto.
    """
    assert options.datum is not None  # the command checks it
    place = source.place, options.datum
    encode, made_of = partial(leaf_output, drape=options.drape), partial(_made_of, drape=options.drape)
    rows = write_outputs(tiles, folder, VERSION, encode, place, executor, made_of=made_of)
    nodes = [Node(row) for row in rows]
    nodes.sort(key=lambda node: str(node.row["id"]))
    bare = [node.row["id"] for node in nodes if node.row["bare"]]
    children, written = [], set[str]()
    for block in blocks(nodes, folder, place, executor):
        column, line = _cell(block, len(LEVELS_M) - 1)
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
    """Write the coarse meshes above tiles; return the coarsest meshes, one per area of the last level."""
    raised = list(nodes)
    for number in range(len(LEVELS_M)):
        raised = _raised(raised, number, folder, place, executor)
    return raised


def _raised(
    nodes: Sequence[Node], number: int, folder: Location, place: Place, executor: Executor
) -> list[Node]:
    """Return the nodes of a level: a coarse mesh per area. The only node of an area is returned unchanged.

    Areas of the last level always have a coarse mesh.
    """
    areas: defaultdict[tuple[int, int], list[Node]] = defaultdict(list)
    for node in nodes:
        areas[_cell(node, number)].append(node)
    raised: list[Node] = []
    below: dict[str, tuple[Node, ...]] = {}
    branches: list[Branch] = []
    for cell, parts in sorted(areas.items()):
        if len(parts) == 1 and (parts[0].children or number + 1 < len(LEVELS_M)):
            raised += parts
            continue
        name = f"{PREFIX}{LEVELS_M[number][0]:.0f}_{cell[0]}_{cell[1]}"
        below[name] = tuple(parts)
        rows = tuple(part.row for part in parts)
        branches.append(Branch(name, number, parts[0].row["cell"], rows, str(folder)))
    for row in write_outputs(branches, folder, VERSION, branch_output, place, executor, f"level{number}"):
        raised.append(Node(row, below[row["id"]]))
    return sorted(raised, key=lambda node: _cell(node, number))


def _cell(node: Node, number: int) -> tuple[int, int]:
    """Return column and row of a node's area of a level."""
    column, line = node.row["cell"]
    return column >> number, line >> number


def _made_of(tile: FinishedTile, drape: bool) -> str:
    own, photo = _choice(tile, drape)
    state = layer_state(tile.tile, "dop") if photo else ""
    return f"{tile.fingerprint} {tile.snapshot.fingerprint} {own} {state}"


def _choice(tile: FinishedTile, drape: bool) -> tuple[bool, bool]:
    """Return whether the GLB file of the run can be used, and whether meshes have the photo."""
    textured = tile.place.pattern.export.texture
    return textured or not drape, textured or drape


def leaf_output(tile: FinishedTile, place: Place, drape: bool) -> TileOutput:
    """Return the GLB file of a tile, a record for coarse meshes, and its row.

    With ``drape`` its mesh has the orthophoto, even if the mesh of the run has none.
    """
    own, draped = _choice(tile, drape)
    mesh, grid, texture = tile.mesh, tile.tile.grid, texture_of(tile) if draped else None
    points = mesh.vertices + mesh.origin
    heights = float(points[:, 2].min()), float(points[:, 2].max())
    name = safe_name(tile.id)
    uri = f"tiles/{name}{glb.NAME}"
    placed = tiles3d.placed(uri, grid.bounds, heights, *place)
    spacing_m, pixel_m = TILE_M
    ground = relief.of_mesh(points, relief.highest_first(mesh), spacing_m)
    colours = glb.ROAD_SRGB, glb.TERRAIN_SRGB
    image = of_classes(points, mesh.faces, mesh.road, colours, ground.bounds, pixel_m)
    if texture:
        photo = joined([aerial_of(texture, pixel_m)], ground.bounds, pixel_m)
        image = replace(photo, share=image.share)
    files, referred = record(name, ground, image)
    side = LEVELS_M[0][0]
    west, south, east, north = grid.bounds
    cell = math.floor((west + east) / 2 / side), math.floor((south + north) / 2 / side)
    row = row_of(tile.id, cell, placed, 0.0, bool(texture)) | {"bare": draped and not texture}
    return TileOutput({uri: _glb(tile, own, place[0].origin, texture), **files}, row | referred)


def _glb(
    tile: FinishedTile, own: bool, origin: tuple[float, float, float], texture: glb.Texture | None
) -> bytes:
    """Return the GLB file of the run, or a new file if the run lacks a suitable one."""
    folder = TileProducts.of(parse_location(tile.place.path), tile.id)
    file = folder.file(file_name(tile.id, tile.variant, GLB))
    if (own or not texture) and exists(file):
        data = read(file)
        tile.check_unchanged()
        return data
    normals = mesh_normals(tile.mesh, tile.surface)
    return glb.encode(tile.mesh, origin, texture, normals, tile.id)


def _encoded(content: dict[str, Any]) -> bytes:
    return json.dumps(content, separators=(",", ":"), allow_nan=False).encode()


@dataclass(frozen=True, eq=False)
class Aerial:
    """An image of the ground, row 0 in the north."""

    bounds: Bounds
    """West, south, east and north of its outer edges (m)."""
    colour: Floats
    """Red, green and blue, 0 to 255, ``(h, w, 3)``."""
    share: Floats
    """Known share of each pixel, 0 to 1, ``(h, w)``. The colour of a pixel with share 0 has no meaning."""

    def complete(self) -> NDArray[np.uint8]:
        """Return the colours, ``(h, w, 3)``; an unknown pixel has the colour of the nearest known pixel."""
        row, column = scipy.ndimage.distance_transform_edt(
            self.share == 0, return_distances=False, return_indices=True
        )
        return np.asarray(np.rint(self.colour[row, column]), np.uint8)


def of_classes(
    points: Floats,
    faces: NDArray[np.int32],
    road: Bools,
    colours: tuple[Sequence[int], Sequence[int]],
    bounds: Bounds,
    pixel_m: float,
) -> Aerial:
    """Return an image of a mesh with one colour for road and one for terrain.

    - `colours`: red, green and blue of road and of terrain, 0 to 255.
    - `pixel_m`: largest size of a pixel (m).
    """
    rows, columns = shape(bounds, pixel_m)
    west, south, east, north = bounds
    fine = rows * SAMPLES, columns * SAMPLES
    half_x, half_y = (east - west) / fine[1] / 2, (north - south) / fine[0] / 2
    centres = west + half_x, south + half_y, east - half_x, north - half_y
    covered, paved = (np.isfinite(at_nodes(points, kept, centres, fine)) for kept in (faces, faces[road]))

    def mean(mask: Bools) -> Floats:
        return np.asarray(mask.reshape(rows, SAMPLES, columns, SAMPLES).mean(axis=(1, 3)))

    share = mean(covered)
    part = (mean(paved) / np.where(share > 0, share, 1.0))[..., None]
    colour = part * np.asarray(colours[0], float) + (1 - part) * np.asarray(colours[1], float)
    return Aerial(bounds, colour, share)


def joined(parts: Sequence[Aerial], bounds: Bounds, pixel_m: float) -> Aerial:
    """Return one image of several images over bounds; where images overlap, it has their mean."""
    rows, columns = shape(bounds, pixel_m)
    west, south, east, north = bounds
    x, y = np.linspace(west, east, columns + 1), np.linspace(south, north, rows + 1)[::-1]
    colour, weight = np.zeros((rows, columns, 3)), np.zeros((rows, columns))
    for part in parts:
        height, width = part.share.shape
        across = _common(np.linspace(part.bounds[0], part.bounds[2], width + 1), x)
        along = _common(-np.linspace(part.bounds[3], part.bounds[1], height + 1), -y)
        # Each part covers only some of the pixels.
        row, column = (np.flatnonzero(lengths.any(axis=1)) for lengths in (along, across))
        along, across = along[row], across[column].T
        place = np.ix_(row, column)
        weight[place] += along @ part.share @ across
        known = part.share[..., None] * part.colour
        colour[place] += np.stack([along @ known[..., band] @ across for band in range(3)], axis=-1)
    area = (east - west) * (north - south) / (rows * columns)
    colour /= np.where(weight > 0, weight, 1.0)[..., None]
    return Aerial(bounds, colour, np.minimum(weight / area, 1.0))


def shape(bounds: Bounds, pixel_m: float) -> tuple[int, int]:
    """Return rows and columns of the smallest image with pixels of this size or less (m)."""
    west, south, east, north = bounds
    rows, columns = (max(1, int(np.ceil(length / pixel_m - 1e-6))) for length in (north - south, east - west))
    return rows, columns


def _common(parts: Floats, pixels: Floats) -> Floats:
    """Return the common length of each interval of pixels with each interval of parts; edges ascend."""
    low = np.maximum(pixels[:-1, None], parts[None, :-1])
    high = np.minimum(pixels[1:, None], parts[None, 1:])
    return np.asarray(np.maximum(high - low, 0.0))


def aerial_of(texture: glb.Texture, pixel_m: float) -> Aerial:
    """Return a texture reduced to pixels of at most half of ``pixel_m`` (m), if its own are smaller."""
    west, south, east, north = texture.bounds
    image = Image.open(io.BytesIO(texture.jpeg))
    dx, dy = (east - west) / image.width, (north - south) / image.height
    # Large photos would take a gigabyte as numbers.
    factor = max(1, int(pixel_m / max(dx, dy) / 2))
    colour = np.asarray(image.reduce(factor), np.float64)
    rows, columns = colour.shape[:2]
    bounds = west, north - rows * factor * dy, west + columns * factor * dx, north
    return Aerial(bounds, colour, np.ones((rows, columns)))
