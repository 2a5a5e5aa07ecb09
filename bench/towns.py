"""Two real towns of FLEXROAD_REAL_DATA with their canopies; road is all paved ground."""

import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import rasterio

from flexroad.catalog import Catalog
from flexroad.catalog.sources import rasters
from flexroad.tasks.types import Bools, Floats

PAVED = 1
ARCHIVES = {
    "Barbican": ("London_BNG", "EPSG:27700", {
        "dsm": "dsm_barb*.tif", "dtm": "dem_barb*.tif", "canopy": "cdsm_barb*.tif", "cover": "landcover*.tif",
    }),
    "Gothenburg": ("Goteborg_SWEREF99_1200", "EPSG:3007", {
        "dsm": "DSM_KR*.tif", "dtm": "DEM_KR*.tif", "canopy": "CDSM_KR*.asc", "cover": "landcover.tif",
    }),
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class Town:
    """The rasters of a town, all on one lattice, as arrays ``(H, W)``; NaN is nodata."""

    folder: Path
    crs: str
    patterns: dict[str, str]
    profile: dict[str, Any]
    """The profile of its rasters, for heights as float64."""
    dsm: Floats
    """With canopies (m)."""
    dtm: Floats
    covered: Bools
    """Cells below a canopy."""
    cover: Floats
    """Classes of land cover."""

    @classmethod
    def unpacked(cls, name: str, data: Path, folder: Path) -> "Town":
        """Return a town of the data folder, unpacked into a folder."""
        archive, crs, patterns = ARCHIVES[name]
        zipfile.ZipFile(data / "umep" / f"{archive}.zip").extractall(folder)
        layers = {}
        for layer, pattern in patterns.items():
            with rasterio.open(next((folder / archive).glob(pattern))) as raster:
                layers[layer] = raster.read(1, masked=True).astype(np.float64).filled(np.nan)
                if layer == "dtm":
                    profile = {**raster.profile, "driver": "GTiff", "dtype": "float64", "nodata": -9999.0}
        dtm = layers["dtm"]
        dsm = np.fmax(layers["dsm"], dtm + np.nan_to_num(layers["canopy"]))
        covered = (layers["canopy"] > 0) & (dsm > layers["dsm"])
        return cls(folder / archive, crs, patterns, profile, dsm, dtm, covered, layers["cover"])

    def catalog(self, dsm: Floats, dtm: Floats, **layers: str) -> Catalog:
        """Return a catalog of these heights, with more layers by the patterns of their files."""
        for name, heights in (("other_dsm.tif", dsm), ("other_dtm.tif", dtm)):
            with rasterio.open(self.folder / name, "w", **self.profile) as raster:
                raster.write(np.nan_to_num(heights, nan=-9999.0), 1)
        files = {
            "dsm": "other_dsm.tif",
            "dtm": "other_dtm.tif",
            "road_mask": self.patterns["cover"],
            **layers,
        }
        return Catalog(rasters.index(self.folder, files, road_values=(PAVED,), crs=self.crs).tiles)
