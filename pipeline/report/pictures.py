"""The pictures of a report: maps and mesh views of its tiles."""

from __future__ import annotations

from flexroad.pipeline.graph.graph import TileGraph
from flexroad.pipeline.report.content import Content
from flexroad.pipeline.report.mesh_pictures import render_meshes
from flexroad.pipeline.report.pages import TilePictures
from flexroad.pipeline.report.render import error_map, filter_picture, hillshade, support_picture
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.run.status import Track, peek_statuses, untracked
from flexroad.pipeline.store.artefacts import ArtefactStore
from flexroad.pipeline.worker.evaluator import Evaluator, StageError
from flexroad.tasks.metrics.vertical_distance import drape
from flexroad.tasks.types import Mesh, Quality, RoadClusters, RoadMask, TileData

MOST = 24
"""Largest number of tiles of which all are shown; of larger runs only the worst are shown."""
NO_MESH = "No 3D view: no usable OpenGL library (on Debian: apt-get install libegl1)."


def tile_pictures(run: Run, content: Content, track: Track = untracked) -> list[TilePictures]:
    """Draw the exported variant of every tile, or of the worst tiles of a large run."""
    variant = run.config.export.variants[0]
    tile_ids = _shown(content)
    maps: dict[str, TilePictures] = {}
    meshes: dict[str, Mesh] = {}
    tiles = {tile.id: tile for tile in run.catalog.tiles}
    statuses = peek_statuses(run, [tiles[tile_id] for tile_id in tile_ids])
    for status in track(statuses, "drawing tiles", len(tile_ids)):
        graph = status.graph
        evaluate = Evaluator(graph, ArtefactStore(run.store))
        try:
            meshes[graph.tile.id] = evaluate(graph.variants[variant]["sample"])
            maps[graph.tile.id] = _maps(graph, variant, evaluate)
        except StageError as error:
            # For example if source files were deleted after the run; the tables do not need them.
            maps[graph.tile.id] = TilePictures(graph.tile.id, (), (f"No pictures: {error}",))
    views = render_meshes(meshes)
    return [_with_view(pictures, views.get(tile_id)) for tile_id, pictures in maps.items()]


def _shown(content: Content) -> list[str]:
    if len(content.tiles) <= MOST:
        return list(content.tiles)
    return list(dict.fromkeys([*content.worst["tile"], *content.worst_estimates["tile"]]))


def _maps(graph: TileGraph, variant: str, evaluate: Evaluator) -> TilePictures:
    nodes = graph.variants[variant]
    data: TileData = evaluate(nodes["load"])
    road: RoadMask = evaluate(nodes["segment"])
    clusters: RoadClusters = evaluate(nodes["ecsrc"])
    mesh: Mesh = evaluate(nodes["sample"])
    quality: Quality = evaluate(nodes["assess"])
    core, window = data.core, data.grid.window(data.core)
    dsm, raw, kept = data.dsm[window], road.mask[window], clusters.mask[window]
    truth = (data.dtm if data.reference is None else data.reference)[window]
    against = "DTM" if data.reference is None else "reference"
    return TilePictures(
        graph.tile.id,
        (
            ("DSM", hillshade(dsm, core)),
            ("Road mask: before and after the filter", filter_picture(dsm, raw, kept, core)),
            ("Support of the surface along the road", support_picture(dsm, quality.support, raw, core)),
            (
                f"{variant} minus {against}",
                error_map(drape(mesh, core) + mesh.origin[2] - truth, core, road=raw),
            ),
        ),
        (*_flags(quality), *data.notes, *road.notes),
    )


def _flags(quality: Quality) -> tuple[str, ...]:
    return (f"Flags: {', '.join(quality.flags)}.",) if quality.flags else ()


def _with_view(tile: TilePictures, view: bytes | None) -> TilePictures:
    if not tile.pictures:
        return tile
    if view is None:
        return TilePictures(tile.tile_id, tile.pictures, (*tile.notes, NO_MESH))
    return TilePictures(tile.tile_id, (*tile.pictures, ("Mesh, from the south", view)), tile.notes)
