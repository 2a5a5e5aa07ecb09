"""Rasters of a survey: as heights, as an orthophoto, and by `flexroad catalog rasters`."""

from pathlib import Path

import numpy as np

from flexroad.catalog import CatalogError, Grid
from flexroad.catalog.scan.rasters import quiet
from flexroad.catalog.sources.rasters import index
from flexroad.tasks import TaskError
from flexroad.tasks.io.orthophoto import read_photo
from flexroad.tasks.io.raster import read_window
from flexroad.tasks.types import Source
from tests.make_rasters import UTM, write, write_xyz

SIDE = 64
WEST, NORTH = 295500.0, 5629500.0
GRID = Grid(UTM, WEST, NORTH, 1.0, SIDE, SIDE)
AUX = """<PAMDataset>
<Metadata><MDI key="AREA_OR_POINT">Area</MDI></Metadata>
<PAMRasterBand band="1"><NoDataValue>-9999</NoDataValue><UnitType>m</UnitType></PAMRasterBand>
</PAMDataset>
"""


def make(folder: Path) -> list[Path]:
    heights = np.random.default_rng(0).normal(100, 3, (SIDE, SIDE)).astype(np.float32)
    grey = np.clip(heights, 0, 255).astype(np.uint8)
    tiled = {"tiled": True, "blockxsize": 32, "blockysize": 32, "compress": "deflate", "nodata": -9999}
    made = [
        write(folder / "plain.tif", heights),
        write(folder / "tiled.tif", heights, **tiled),
        write(folder / "lzw.tif", heights, compress="lzw", predictor=3),
        write(folder / "big.tif", heights, bigtiff="yes"),
        write(folder / "classes.tif", grey),
        write(folder / "grid.asc", heights, driver="AAIGrid"),
        write(folder / "grey.png", grey, driver="PNG", worldfile="yes"),
        write(folder / "grey.jpg", grey, driver="JPEG", worldfile="yes"),
        write(folder / "grey.jp2", grey, driver="JP2OpenJPEG"),
        write_xyz(folder / "points.xyz", heights, WEST, NORTH),
        folder / "plain.tif.aux.xml",
    ]
    (folder / "plain.tif.aux.xml").write_text(AUX)
    return made


def read(path: Path) -> None:
    raster = path.with_suffix("").with_suffix("") if path.name.endswith(".aux.xml") else path
    name = f"dsm {path.name}"
    errors = []
    with quiet():
        for attempt in (
            lambda: read_window(raster, name, GRID, GRID, UTM),
            lambda: read_photo(Source("dop", (raster,), UTM), GRID),
            lambda: index(path.parent, {"dsm": raster.name, "dtm": raster.name}, crs=UTM, tile_size_m=SIDE),
        ):
            try:
                attempt()
            except (TaskError, CatalogError) as error:
                errors.append(error)
    if len(errors) == 3:
        raise errors[0]
