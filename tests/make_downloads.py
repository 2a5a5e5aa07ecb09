"""Folders of downloads as users have them, made from synthetic scenes with known heights."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import geopandas
import numpy as np
import rasterio
import shapely
import trimesh
from PIL import Image
from rasterio.features import shapes
from rasterio.merge import merge
from rasterio.warp import Resampling, calculate_default_transform, reproject

from flexroad.tools.synthetic.scenes import write_scenes
from tests import make_photos
from tests.make_clouds import write_cloud
from tests.make_rasters import write

PAVED, GRASS = 1, 2
SIDE_M = 120
CRS = "EPSG:25832"


@dataclass(frozen=True)
class Area:
    """Rasters of 120 m x 120 m with cells of 1 m; row 0 in the north."""

    west: float
    north: float
    dsm: np.ndarray
    dtm: np.ndarray
    road: np.ndarray

    @property
    def centres(self) -> tuple[np.ndarray, np.ndarray]:
        """Eastings and northings of the cells."""
        east = self.west + 0.5 + np.arange(self.dsm.shape[1])
        north = self.north - 0.5 - np.arange(self.dsm.shape[0])
        return np.meshgrid(east, north)

    @property
    def road_polygons(self) -> list[shapely.Geometry]:
        place = rasterio.Affine(1, 0, self.west, 0, -1, self.north)
        parts = shapes(self.road.astype(np.uint8), mask=self.road, transform=place)
        return [shapely.geometry.shape(part) for part, _ in parts]


@cache
def area() -> Area:
    """Return four neighbouring scenes as one area."""
    with TemporaryDirectory() as folder:
        write_scenes(Path(folder), 4, seed=7, size_m=SIDE_M // 2)
        layers = {}
        for name in ("dsm", "dtm", "road_mask"):
            layers[name], place = merge(sorted(Path(folder, name).glob("*.tif")))
    return Area(place.c, place.f, layers["dsm"][0], layers["dtm"][0], layers["road_mask"][0] == 1)


def raster_city(folder: Path) -> None:
    """DSM, DTM and land cover in sheets of 60 m, as a city publishes them."""
    made = area()
    cover = np.where(made.road, PAVED, GRASS).astype(np.uint8)
    for row, column in np.ndindex(2, 2):
        part = np.s_[60 * row : 60 * row + 60, 60 * column : 60 * column + 60]
        west, north = made.west + 60 * column, made.north - 60 * row
        sheet = f"{west:.0f}_{north - 60:.0f}.tif"
        for name, values in (("dsm", made.dsm), ("dtm", made.dtm), ("landcover", cover)):
            (folder / name).mkdir(parents=True, exist_ok=True)
            write(folder / name / sheet, values[part], west, north, crs=CRS)


def old_town(folder: Path) -> None:
    """A classified laser scan in two LAZ files, and a GeoPackage of roads and buildings."""
    made = area()
    rng = np.random.default_rng(3)
    east, north = (
        np.repeat(axis.ravel(), 4) + rng.uniform(-0.5, 0.5, 4 * axis.size) for axis in made.centres
    )
    row = np.clip((made.north - north).astype(int), 0, SIDE_M - 1)
    column = np.clip((east - made.west).astype(int), 0, SIDE_M - 1)
    height = made.dsm[row, column] + rng.normal(0, 0.02, east.size)
    kind = np.where(np.abs(made.dsm - made.dtm)[row, column] < 0.2, 2, 1)
    points = np.column_stack([east, north, height])
    middle = made.west + SIDE_M / 2
    for name, half in (("c_west", east < middle), ("c_east", east >= middle)):
        write_cloud(folder / f"{name}.laz", points[half], kind[half], CRS)
    roads = geopandas.GeoDataFrame(geometry=made.road_polygons, crs=CRS).assign(function="road")
    roads.to_file(folder / "topography.gpkg", layer="road_part")
    house = shapely.box(made.west + 5, made.north - 15, made.west + 15, made.north - 5)
    houses = geopandas.GeoDataFrame({"storeys": [2]}, geometry=[house], crs=CRS)
    houses.to_file(folder / "topography.gpkg", layer="building")


def drone_mesh(folder: Path) -> None:
    """A textured mesh with local coordinates and the position of its origin, and road polygons."""
    made = area()
    folder.mkdir(parents=True)
    origin = np.array([made.west, made.north - SIDE_M, 0])
    east, north = made.centres
    x, y = east - origin[0], north - origin[1]
    number = np.arange(x.size).reshape(x.shape)
    nw, sw, se, ne = number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]
    faces = np.stack([sw, se, ne, sw, ne, nw], axis=-1).reshape(-1, 3)
    colours = np.where(made.road[..., None], (90, 90, 95), (80, 130, 60)).astype(np.uint8)
    skin = trimesh.visual.TextureVisuals(
        np.column_stack([x.ravel(), y.ravel()]) / SIDE_M, image=Image.fromarray(colours)
    )
    vertices = np.column_stack([x.ravel(), y.ravel(), made.dsm.ravel()])
    trimesh.Trimesh(vertices, faces, visual=skin, process=False).export(folder / "scene.obj")
    (folder / "metadata.xml").write_text(
        f'<?xml version="1.0"?><ModelMetadata version="1"><SRS>{CRS}</SRS>'
        f"<SRSOrigin>{origin[0]},{origin[1]},0</SRSOrigin></ModelMetadata>\n"
    )
    roads = geopandas.GeoDataFrame(geometry=made.road_polygons, crs=CRS).assign(kind="road")
    roads.to_file(folder / "roads.gpkg")


def flight(folder: Path) -> None:
    """Photographs of a hill with GNSS tags, and the centre line of a road with its width."""
    folder.mkdir(parents=True)
    make_photos.photographs(folder)
    west, south = make_photos.CORNER
    line = shapely.LineString([(west + 25, south + 35), (west + 46, south + 36)])
    lines = geopandas.GeoDataFrame({"width_m": [5.0]}, geometry=[line], crs=make_photos.CRS)
    lines.to_file(folder / "roads.geojson", driver="GeoJSON")


def countryside(folder: Path) -> None:
    """The rasters of `raster_city`, with roads in the western half alone."""
    raster_city(folder)
    for file in (folder / "landcover").glob(f"{area().west + 60:.0f}_*.tif"):
        with rasterio.open(file, "r+") as cover:
            cover.write(np.full((60, 60), GRASS, np.uint8), 1)


def country(folder: Path) -> None:
    """One country in two zones: terrain model and land cover are files of the neighbouring zone."""
    made = area()
    inner = np.s_[10:-10, 10:-10]
    write(folder / "dsm.tif", made.dsm[inner], made.west + 10, made.north - 10, crs=CRS)
    cover = np.where(made.road, PAVED, GRASS).astype(np.uint8)
    _write_in_zone(folder / "dtm.tif", made.dtm, "EPSG:25833", Resampling.bilinear, -9999.0)
    _write_in_zone(folder / "landcover.tif", cover, "EPSG:25833", Resampling.nearest, 0)


def _write_in_zone(file: Path, values: np.ndarray, crs: str, method: Resampling, nodata: float) -> None:
    place = rasterio.Affine(1, 0, area().west, 0, -1, area().north)
    bounds = rasterio.transform.array_bounds(SIDE_M, SIDE_M, place)
    there, width, height = calculate_default_transform(CRS, crs, SIDE_M, SIDE_M, *bounds, resolution=1.0)
    warped = np.full((height, width), nodata, values.dtype)
    places = {"src_transform": place, "src_crs": CRS, "dst_transform": there, "dst_crs": crs}
    reproject(values, warped, **places, dst_nodata=nodata, resampling=method)
    write(file, warped, crs=crs, transform=there, nodata=nodata)


DOWNLOADS: dict[str, Callable[[Path], None]] = {
    made.__name__: made for made in (raster_city, old_town, drone_mesh, flight, countryside, country)
}
"""The folders by name."""
