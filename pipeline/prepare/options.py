"""The options shared by all ``flexroad prepare`` commands."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from flexroad.catalog.limits import MIN_COVER
from flexroad.pipeline.errors import ConfigError


def written(paths: Iterable[Path]) -> datetime:
    """Return when the latest of some files was written."""
    return datetime.fromtimestamp(max(path.stat().st_mtime for path in paths), UTC)


@dataclass(frozen=True)
class PrepareOptions:
    """The options shared by all commands."""

    cell_m: float = 1.0
    """Cell of the heights (m)."""
    dop_cell_m: float = 0.5
    """Pixel of the orthophoto (m)."""
    crs: str | None = None
    """CRS of inputs without one."""
    to_crs: str | None = None
    """CRS of the rasters, in metres; by default derived from that of the input."""
    height_unit: str | None = None
    """``metre``, ``foot`` or ``us-foot``, if the input's CRS has no height unit; by default its plan unit."""
    roads: Path | None = None
    """Roads for the mask: polygons, a raster, or a mesh projected vertically; lines make no mask."""
    roads_layer: str | None = None
    """Layer of ``roads``, for a vector file with several."""
    roads_where: str | None = None
    """SQL condition that selects features of ``roads``: ``class = 'road'``."""
    tile_size_m: float = 250
    """Side of a tile (m)."""
    min_cover: float = MIN_COVER
    """Tiles with a DSM height in less than this share (0 to 1) of their cells are left out."""
    date: datetime | None = None
    """Acquisition date; takes precedence over the files."""
    assumed_date: datetime | None = None
    """Date, marked as assumed, if neither the option nor the files give one."""
    dataset: str | None = None
    """Name of the data in reports; by default the name of the source."""

    @property
    def step_m(self) -> float:
        """The larger of cell and pixel (m), a multiple of the smaller; grids are aligned to multiples of it.

        Raises
        ------
        ConfigError
            If a size is not positive, or neither is a multiple of the other.
        """
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
