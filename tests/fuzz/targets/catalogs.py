"""Catalogs, in JSON and GeoParquet: their tiles, and the list of their faults."""

from pathlib import Path

from flexroad.catalog import Catalog
from flexroad.catalog.index import check_allowed
from flexroad.pipeline.config.loading import load_config
from flexroad.tools.check.catalog import check
from flexroad.tools.synthetic.scenes import write_scenes


def make(folder: Path) -> list[Path]:
    write_scenes(folder / "survey", 2, seed=3, size_m=40)
    catalog = Catalog.read(folder / "survey" / "catalog.parquet", [folder])
    made = [folder / "catalog.json", folder / "catalog.parquet"]
    for path in made:
        catalog.write(path)
    return made


def read(path: Path) -> None:
    catalog = Catalog.read(path)
    check_allowed(catalog)
    for tile in catalog.usable:
        for layer in tile.layers:
            tile.paths(layer)
    list(check(catalog, load_config("production"), path))
