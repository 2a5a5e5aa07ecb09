"""The options shared by all ``flexroad prepare`` commands."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Literal

from flexroad.catalog.limits import MIN_COVER
from flexroad.pipeline.config.options import INPUTS, RASTERS, option
from flexroad.pipeline.errors import ConfigError


def written(paths: Iterable[Path]) -> datetime:
    """Return when the latest of some files was written."""
    return datetime.fromtimestamp(max(path.stat().st_mtime for path in paths), UTC)


@dataclass(frozen=True)
class PrepareOptions:
    """The options shared by all commands; the command line makes its options of these fields."""

    cell_m: float = option(1.0, RASTERS, "Cell of the heights in m.", "METRES", min=0.01)
    dop_cell_m: float = option(0.5, RASTERS, "Pixel of the orthophoto in m.", "METRES", min=0.01)
    crs: str | None = option(None, INPUTS, "CRS of inputs without one, e.g. EPSG:2994.", "CRS")
    to_crs: str | None = option(None, RASTERS, "CRS of the rasters; default: the input's, in metres.", "CRS")
    height_unit: Literal["metre", "foot", "us-foot"] | None = option(
        None, INPUTS, "Unit of heights if the CRS has none; default: that of the plan."
    )
    roads: Path | None = option(
        None, INPUTS, "Roads: polygons, a raster or a mesh, for the mask; or lines.", "FILE"
    )
    """A mesh is projected vertically; lines make no mask."""
    roads_layer: str | None = option(None, INPUTS, "Layer of --roads, if the file has several.", "NAME")
    roads_where: str | None = option(None, INPUTS, "SQL condition on --roads: \"class = 'road'\".", "SQL")
    tile_size_m: float = option(250, RASTERS, "Side of a tile in m; a smaller area is one tile.", "METRES")
    min_cover: float = MIN_COVER
    """Tiles with a DSM height in less than this share of their cells are left out."""
    date: datetime | None = option(
        None, INPUTS, "Date of the survey; default: that of the files.", "YYYY-MM-DD"
    )
    assumed_date: datetime | None = None
    """Date, marked as assumed, if neither the option nor the files give one; not on the command line."""
    dataset: str | None = None
    """Name of the data in reports; None: the name of the input."""

    @property
    def step_m(self) -> float:
        """The larger of cell and pixel (m), a multiple of the smaller; grids are aligned to its multiples."""
        small, large = sorted((self.cell_m, self.dop_cell_m))
        pair = f"--cell {self.cell_m:g} --dop-cell {self.dop_cell_m:g}"
        if not small > 0:
            raise ConfigError(
                f"--cell {self.cell_m:g} --dop-cell {self.dop_cell_m:g}: both must be greater than 0 m"
            )
        if abs(large / small - round(large / small)) > 1e-9:
            raise ConfigError(
                f"{pair}: one must be a multiple of the other; "
                f"use --dop-cell {self.cell_m / max(1, round(self.cell_m / self.dop_cell_m)):g}"
            )
        return large
