"""Which pictures a report shows of which tiles."""

from __future__ import annotations

from flexroad.pipeline.graph.graph import TileGraph
from flexroad.pipeline.report.content import Content
from flexroad.pipeline.report.mesh_pictures import render_meshes
from flexroad.pipeline.report.pages import TilePictures
from flexroad.pipeline.report.render import error_map, filter_picture, hillshade, support_picture
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.run.status import peek_statuses
from flexroad.pipeline.store.artefacts import ArtefactStore
from flexroad.pipeline.worker.evaluator import Evaluator, StageError
from flexroad.tasks.metrics.vertical_distance import drape
from flexroad.tasks.types import Mesh, Quality, RoadClusters, RoadMask, TileData

MOST = 24
"""Tiles shown; of larger runs the worst."""
NO_MESH = "No 3D view: no OpenGL library could be used here (on Debian: apt-get install libegl1)."


def tile_pictures(run: Run, content: Content) -> list[TilePictures]:
    """Draw the exported variant of every tile, or of the worst where there are many."""
    variant = run.config.export.variants[0]
    shown = _shown(content)
    maps: dict[str, TilePictures] = {}
    meshes: dict[str, Mesh] = {}
    known = {tile.id: tile for tile in run.catalog.tiles}
    for found in peek_statuses(run, [known[tile_id] for tile_id in shown]):
        graph = found.graph
        pull = Evaluator(graph, ArtefactStore(run.store))
        try:
            meshes[graph.tile.id] = pull(graph.variants[variant]["sample"])
            maps[graph.tile.id] = _maps(graph, variant, pull)
        except StageError as error:
            # The sources may be gone since; the tables stand all the same.
            maps[graph.tile.id] = TilePictures(graph.tile.id, (), (f"No pictures: {error}",))
    views = render_meshes(meshes)
    return [_with_view(found, views.get(tile_id)) for tile_id, found in maps.items()]


def _shown(content: Content) -> list[str]:
    if len(content.tiles) <= MOST:
        return list(content.tiles)
    return list(dict.fromkeys([*content.worst["tile"], *content.doubtful["tile"]]))


def _maps(graph: TileGraph, variant: str, pull: Evaluator) -> TilePictures:
    made = graph.variants[variant]
    data: TileData = pull(made["load"])
    road: RoadMask = pull(made["segment"])
    clusters: RoadClusters = pull(made["ecsrc"])
    mesh: Mesh = pull(made["sample"])
    quality: Quality = pull(made["assess"])
    core, window = data.core, data.grid.window(data.core)
    dsm, raw, kept = data.dsm[window], road.mask[window], clusters.mask[window]
    truth = (data.dtm if data.reference is None else data.reference)[window]
    against = "DTM" if data.reference is None else "reference"
    return TilePictures(
        graph.tile.id,
        (
            ("DSM", hillshade(dsm, core)),
            ("Road mask: before and after the filter", filter_picture(dsm, raw, kept, core)),
            ("What the surface rests on", support_picture(dsm, quality.support, raw, core)),
            (
                f"{variant} minus {against}",
                error_map(drape(mesh, core) + mesh.origin[2] - truth, core, road=raw),
            ),
        ),
        (*_flagged(quality), *data.notes),
    )


def _flagged(quality: Quality) -> tuple[str, ...]:
    return (f"Flags: {', '.join(quality.flags)}.",) if quality.flags else ()


def _with_view(found: TilePictures, view: bytes | None) -> TilePictures:
    if not found.pictures:
        return found
    if view is None:
        return TilePictures(found.tile_id, found.pictures, (*found.notes, NO_MESH))
    return TilePictures(found.tile_id, (*found.pictures, ("Mesh, from the south", view)), found.notes)
