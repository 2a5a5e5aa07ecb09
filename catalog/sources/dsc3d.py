"""DSC3D, the DeepScenario Open 3D Dataset: scenes of any size, rastered from photogrammetric meshes.

The paper evaluates on rasters made from the scenes' meshes, with true heights of their own; this source
reads such rasters, one set per scene. How anyone's folder names them is not known here, so templates tell
(`catalog.layout`); those of ``configs/dsc3d.yaml`` are a guess until one has seen the folder.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Any

from flexroad.catalog.headers.rasters import some
from flexroad.catalog.path_templates import Layout, read
from flexroad.catalog.tiling import TilingResult

DATASET = "DSC3D"


def index(root: Path, layout: Mapping[str, Any], *, date: datetime | None = None) -> TilingResult:
    """Return the scenes of a folder, one tile each.

    Parameters
    ----------
    root : Path
        The folder.
    layout : Mapping[str, Any]
        ``layers`` (templates), ``road_values`` and ``crs``, as a configuration's ``dataset`` holds them.
    date : datetime, optional
        When the data was taken; overrules the files.

    Raises
    ------
    CatalogError
        If the layout is none, or the folder does not hold what it says.
    """
    found = read(root, Layout.of(layout), dataset=DATASET, date=date)
    untold = [tile.id for tile in found.tiles if tile.layer("reference") is None]
    if not untold:
        return found
    # The paper's truth takes roads from the filtered DSM, terrain from the refined DTM.
    note = f"no reference for {some(untold)}: the DTM stands in for it, unlike in the paper"
    return replace(found, notes=(*found.notes, note))
