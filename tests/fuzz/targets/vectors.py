"""Roads as vector files: in `segment: vector`, and by `flexroad catalog rasters`."""

from pathlib import Path

from shapely import LineString, Polygon

from flexroad.catalog import CatalogError
from flexroad.catalog.scan.rasters import quiet
from flexroad.catalog.scan.vectors import opened
from flexroad.tasks import TaskError
from flexroad.tasks.segment import vector
from tests.make_roads import GRID, on_grid, tile, write, write_osm

PARTS = (".shp", ".shx", ".dbf", ".prj")


def make(folder: Path) -> list[Path]:
    lines = [LineString(on_grid((0, 20), (50, 30), (99, 20))), LineString(on_grid((40, 0), (45, 99)))]
    area = [Polygon(on_grid((10, 10), (40, 12), (38, 50), (12, 48)))]
    columns = {"highway": ["primary", "residential"], "width": ["7.5", None], "lanes": ["2", "1"]}
    made = [write(folder / f"lines.{kind}", lines, **columns) for kind in ("geojson", "gpkg", "fgb", "shp")]
    made += [write(folder / f"area.{kind}", area) for kind in ("geojson", "gpkg")]
    write_osm(folder / "way.osm", {"highway=primary;lanes=2": [(7.55, 51.44), (7.56, 51.45)]})
    return [*made, *(folder / f"lines{end}" for end in PARTS[1:]), folder / "way.osm"]


def read(path: Path) -> None:
    file = path.with_suffix(".shp") if path.suffix in PARTS else path
    errors = []
    with quiet():
        for attempt in (
            lambda: vector.segment(tile(file), vector.Options(method="vector")),
            lambda: opened(file, GRID.crs),
        ):
            try:
                attempt()
            except (TaskError, CatalogError) as error:
                errors.append(error)
    if len(errors) == 2:
        raise errors[0]
