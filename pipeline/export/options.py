"""Options of an export, for all formats."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from flexroad.catalog.ellipsoidal import Datum


@dataclass(frozen=True)
class Options:
    """Options of an export."""

    datum: Datum | None = None
    """How heights become heights above the ellipsoid; needed by formats with WGS 84."""
    compress: bool = False
    """Whether text formats of the complete run are compressed with gzip."""
    resolution_m: float | None = None
    """Cell size of rasters over the run (m); None: that of the run."""
    nodes: Literal["power", "unreal"] = "power"
    """Family of sizes of height fields, of `tasks.export.heightfield.SIZES`."""
    drape: bool = False
    """Whether meshes of 3D Tiles and OBJ have the orthophoto, also if those of the run have none."""
    roads: str | None = None
    """File of centre lines for formats along roads; None for the roads of the run's catalog."""
    roads_layer: str | None = None
    """Layer of that file; needed if it has several."""
    left_hand: bool = False
    """Whether traffic keeps left."""
    formats: frozenset[str] = frozenset()
    """Names of the formats that are written together: some refer to files of other formats."""
