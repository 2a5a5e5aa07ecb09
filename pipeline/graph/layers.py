"""The layers that a configuration needs, and the layers that the tiles of a catalog have."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from flexroad.catalog import Catalog, Tile
from flexroad.pipeline.config.models import Config
from flexroad.pipeline.config.stages import stage_version
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.graph.graph import product_layers
from flexroad.tasks.options import stage_module

PRODUCTION = {"road_mask": "production", "roads": "production_vector"}
"""Layer of roads -> the shipped configuration that reads the roads from it; the preferred first."""
METHODS = {"road_mask": "mask", "roads": "vector"}
"""Layer of roads -> the segmentation method that reads it."""
TITLES = {"road_mask": "a road mask", "roads": "vector roads", "dop": "an orthophoto"}
"""Names of layers in messages; another layer has its own name."""
ADD_ROADS = (
    "give roads to the command that made the catalog (--road-mask for rasters, --roads for vectors), "
    "or train a segmenter with `flexroad train`"
)


def needed_layers(config: Config) -> dict[str, str]:
    """Return the layers without which a tile fails, each with the first stage that needs it.

    The stage is named with its method, such as ``segment: mask``.
    """
    needed: dict[str, str] = {}
    for chain in config.chains.values():
        for stage, options in chain.items():
            title = stage_version(stage, options)[0].replace(".", ": ")
            for layer in getattr(stage_module(options), "NEEDS", ()):
                needed.setdefault(layer, title)
    return needed


def lacking(tiles: Sequence[Tile], config: Config) -> Iterator[tuple[str, str, list[str]]]:
    """Yield each needed layer that tiles lack, the stage that needs it, and the ids of these tiles."""
    for layer, stage in needed_layers(config).items():
        ids = [tile.id for tile in tiles if tile.layer(layer) is None]
        if ids:
            yield layer, stage, ids


def without_photo(tiles: Sequence[Tile], config: Config) -> list[str]:
    """Return the ids of tiles whose mesh would have no texture, though the configuration wants one."""
    wanted = product_layers(config.export)
    return [tile.id for tile in tiles if any(tile.layer(layer) is None for layer in wanted)]


def check_layers(config: Config, catalog: Catalog) -> None:
    """Check that the catalog has every layer that the configuration needs, on one tile at least."""
    tiles = catalog.usable
    for layer, stage, ids in lacking(tiles, config):
        if len(ids) == len(tiles):
            title = TITLES.get(layer, f"a {layer}")
            raise ConfigError(
                f"{config.name}: no tile of the catalog has {title} (layer {layer}), which {stage} needs; "
                f"{_remedy(layer, catalog)}"
            )
    if tiles and len(without_photo(tiles, config)) == len(tiles):
        raise ConfigError(
            f"{config.name}: no tile of the catalog has {TITLES['dop']} (layer dop), which export.texture "
            f"needs; {_remedy('dop', catalog)}, or set export.texture to false"
        )


def fitting_config(catalog: Catalog) -> str:
    """Return the shipped production configuration that reads the roads from a layer of the catalog."""
    counts = {layer: sum(tile.layer(layer) is not None for tile in catalog.usable) for layer in PRODUCTION}
    return PRODUCTION[max(counts, key=counts.__getitem__)]


def _remedy(layer: str, catalog: Catalog) -> str:
    if layer not in PRODUCTION:
        return f"add its files to the catalog (`flexroad catalog rasters --{layer}`)"
    for other, name in PRODUCTION.items():
        if any(tile.layer(other) for tile in catalog.usable):
            return f"it has {TITLES[other]}: use --config {name}, or segment: {METHODS[other]}"
    return ADD_ROADS
