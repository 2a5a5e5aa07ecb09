"""DSC3D, the DeepScenario Open 3D Dataset: scenes of any size, rasterised from photogrammetric meshes.

The paper evaluates on rasters made from the scenes' meshes, with separate true heights. This source reads
such rasters, one set per scene. File names differ between users, so templates describe them
(`catalog.path_templates`); the templates in ``configs/dsc3d.yaml`` are a guess, to be adapted to the folder.
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
        ``layers`` (templates), ``road_values`` and ``crs``, as in a configuration's ``dataset``.
    date : datetime, optional
        Date of the survey; overrides the files' dates.

    Raises
    ------
    CatalogError
        If the layout is invalid, or the folder does not match it.
    """
    result = read(root, Layout.of(layout), dataset=DATASET, date=date)
    without = [tile.id for tile in result.tiles if tile.layer("reference") is None]
    if not without:
        return result
    # The paper's reference takes roads from the filtered DSM and terrain from the refined DTM.
    note = f"no reference for {some(without)}: the DTM is used instead, unlike in the paper"
    return replace(result, notes=(*result.notes, note))
