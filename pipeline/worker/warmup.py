"""Compile once what the workers will need: numba keeps it on disk, and each of them then only reads it."""

from __future__ import annotations

import contextlib

from flexroad.pipeline.config.models import Config
from flexroad.pipeline.graph.stages import STAGES, stage_function
from flexroad.tasks.synthetic import SceneOptions, block, make_scene
from flexroad.tasks.types import TileData

SIZE_M = 50
STREETS = SceneOptions(block_m=30)
"""Dense enough that so small a scene has a street."""


def warm(config: Config) -> None:
    """Put a small made scene through every chain of the configuration, from `segment` on."""
    ((tile_id, grid),) = block(1, SIZE_M)
    scene = make_scene(grid, 0, options=STREETS)
    data = TileData(tile_id, grid, grid, scene.dsm, scene.dtm, scene.reference_road)
    for chain in config.chains.values():
        results: dict[str, object] = {"load": data}
        # Options made for real tiles may not suit so small a one; the tiles themselves will tell.
        with contextlib.suppress(Exception):
            for stage in STAGES[1:]:
                options = chain[stage.name]
                inputs = [results[name] for name in stage.inputs]
                results[stage.name] = stage_function(stage.name, options)(*inputs, options)
