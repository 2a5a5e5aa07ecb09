"""Step B of the paper, road extraction: M^r by DINOv2 on the orthophoto.

A frozen backbone and a linear head on its patch tokens are applied to overlapping windows of the photo. A
cell of the DSM takes its mask from the nearest pixel, as in the paper; its probability is the mean over the
cell.
"""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from flexroad.catalog.grid import Grid
from flexroad.catalog.lazy import lazy
from flexroad.tasks import options
from flexroad.tasks.errors import LayerMissing
from flexroad.tasks.io.orthophoto import read_photo
from flexroad.tasks.roads import coregistration
from flexroad.tasks.roads.mask_cleanup import Cleanup, clean
from flexroad.tasks.segment.dinov2.backbone import Backbone, Device, load_backbone, normalised
from flexroad.tasks.segment.dinov2.head import Head, check, predictor, read_head
from flexroad.tasks.segment.dinov2.windows import blend, cover
from flexroad.tasks.types import Bools, Orthophoto, RoadMask, TileData

rasterio = lazy("rasterio")

VERSION = 1
READS = ("dop", "roads")
"""``roads`` is read only if the cleanup uses it."""
NEEDS = ("dop",)
OVERLAP = 0.25
"""Overlap of neighbouring windows, as a fraction of their side: at their edges predictions are worse."""
BATCH = 4
"""Windows per batch; more are not faster on a CPU and need more memory."""
TIE_M = 1e-6
"""Shift of the cell centres to the south-east, so that all tiles choose the same of equally near pixels."""


class Options(options.Options):
    """Model and cleanup. The head defines the size of the windows and the threshold."""

    method: Literal["dinov2"] = "dinov2"
    model: Path = Field(description="file of the head, made by `flexroad train CATALOG`")
    backbone: str | None = Field(
        None, description="hub name or folder of the backbone's weights; null: the head's"
    )
    device: Device = Field("auto", description="cpu, cuda, or auto: a GPU if there is one")
    half: bool = Field(False, description="half precision: float16 on a GPU, bfloat16 on the CPU")
    cleanup: Cleanup = Field(
        "pieces",
        description="pieces: close gaps up to 2 m wide, fill holes up to 10 m2, drop pieces below 25 m2. "
        "corridor: first drop cells over 5 m from the catalog's roads; none: the mask as predicted",
    )


def files(options: Options) -> tuple[Path, ...]:
    """Return the files besides the tile on which the result depends: the head and a local backbone."""
    folder = Path(options.backbone).expanduser() if options.backbone else None
    local = (
        (folder / "config.json", *sorted(folder.glob("*.safetensors"))) if folder and folder.is_dir() else ()
    )
    return options.model, *local


def segment(data: TileData, options: Options) -> RoadMask:
    """Return the road mask predicted from the orthophoto.

    Windows lie on a lattice fixed to the ground and extend beyond the tile and its halo where the photo does.
    So neighbouring tiles agree along their common edge.

    Raises
    ------
    TaskError
        If the tile has no orthophoto, or head or backbone are missing, damaged or do not fit each other.
    """
    if data.dop is None:
        raise LayerMissing(
            "no orthophoto (layer dop), which segment: dinov2 needs; give --dop to "
            "`flexroad catalog rasters`, or use another segmentation method",
            layer="dop",
        )
    head = read_head(options.model)
    backbone = load_backbone(options.backbone or head.about.backbone, options.device, options.half)
    check(head, backbone)
    photo, probability = _predict(data, head, backbone)
    row, col = photo.grid.cells(*_centres(data.grid))
    threshold = head.about.threshold
    mask = clean(probability[row, col] >= threshold, data, options.cleanup)
    notes = _notes(photo.known[row, col], coregistration.note(data, photo))
    if data.lacks_road(mask):
        notes += (
            f"segment: no road on this tile: probabilities reach {probability[row, col].max():.2f}, the "
            f"threshold is {threshold:g}; if there are roads, train on similar tiles",
        )
    return RoadMask(
        grid=data.grid,
        core=data.core,
        mask=mask,
        outside=data.beyond_extent(),
        probability=_mean(probability, photo.grid, data.grid),
        notes=notes,
    )


def _predict(data: TileData, head: Head, backbone: Backbone) -> tuple[Orthophoto, NDArray[np.float32]]:
    """Return the photo around the tile and the road probability of its pixels, 0 where it has no data."""
    gsd_m, size = head.about.gsd_m, head.about.window_px
    overlap = round(size * OVERLAP)
    assert data.dop is not None
    photo = read_photo(data.dop, cover(data.grid, gsd_m, size, overlap), gsd_m)
    image = normalised(photo, head.about.mean, head.about.std)
    blended = blend(predictor(head, backbone), image, photo.known, size, overlap, BATCH)
    return photo, np.where(photo.known, blended, np.float32(0))


def _centres(grid: Grid) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return easting and northing of the cell centres, shifted by `TIE_M`, ``(H, W)`` each."""
    easting, northing = np.meshgrid(grid.eastings + TIE_M, grid.northings - TIE_M)
    return easting, northing


def _mean(probability: NDArray[np.float32], pixels: Grid, grid: Grid) -> NDArray[np.float32]:
    """Return the mean over each cell, ``(H, W)``; bilinear interpolation if pixels are coarser than cells."""
    cells = np.zeros(grid.shape, np.float32)
    rasterio.warp.reproject(
        probability,
        cells,
        src_transform=pixels.transform,
        src_crs=pixels.crs,
        dst_transform=grid.transform,
        dst_crs=grid.crs,
        resampling=rasterio.enums.Resampling.average
        if pixels.cell < grid.cell
        else rasterio.enums.Resampling.bilinear,
    )
    return np.clip(cells, 0, 1)


def _notes(covered: Bools, shifted: str | None) -> tuple[str, ...]:
    share = np.count_nonzero(~covered) / covered.size
    missing = f"dop: {share:.1%} of the cells have no orthophoto and count as no road" if share else None
    return tuple(note for note in (missing, shifted) if note)
