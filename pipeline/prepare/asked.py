"""What every ``flexroad prepare`` command may be asked."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from flexroad.pipeline.errors import ConfigError


@dataclass(frozen=True)
class Asked:
    """The options that all commands share."""

    cell_m: float = 1.0
    """Cell of the heights (m)."""
    dop_cell_m: float = 0.5
    """Pixel of the orthophoto (m)."""
    crs: str | None = None
    """CRS of inputs that carry none."""
    to_crs: str | None = None
    """CRS of the rasters; by default that of the input, in metres."""
    height_unit: str | None = None
    """``metre``, ``foot`` or ``us-foot``, for inputs that do not say; by default the unit of their plan."""
    roads: Path | None = None
    """Roads to burn into the mask: polygons, a raster, or a mesh seen from above; lines make no mask."""
    roads_layer: str | None = None
    """Layer of ``roads``."""
    roads_where: str | None = None
    """Which features of ``roads``, in SQL: ``class = 'road'``."""
    tile_size_m: float = 250
    """Side of a tile (m)."""
    date: datetime | None = None
    """When the data was taken; overrules the files."""
    dataset: str | None = None
    """What reports call the data; by default the name of the source."""

    @property
    def step_m(self) -> float:
        """The larger of cell and pixel (m), a whole number of the smaller: areas begin at multiples of it.

        Raises
        ------
        ConfigError
            If neither is a whole number of the other.
        """
        small, large = sorted((self.cell_m, self.dop_cell_m))
        pair = f"--cell {self.cell_m:g} --dop-cell {self.dop_cell_m:g}"
        if not small > 0:
            raise ConfigError(
                f"--cell {self.cell_m:g} --dop-cell {self.dop_cell_m:g}: both must be above 0 m"
            )
        if abs(large / small - round(large / small)) > 1e-9:
            raise ConfigError(
                f"{pair}: one must be a whole number of the other; "
                f"take --dop-cell {self.cell_m / max(1, round(self.cell_m / self.dop_cell_m)):g}"
            )
        return large
