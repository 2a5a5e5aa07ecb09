"""Writer of the rasters of one area: block by block, then published together as COGs with a catalog.

Until they are published, all files are in a hidden folder inside the output folder. So a failure leaves no
files behind, and new rasters replace old rasters by renaming. The catalog is written last.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from itertools import compress
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
import rasterio
import rasterio.shutil
from numpy.typing import NDArray
from rasterio.errors import CRSError, RasterioError
from rasterio.windows import Window

from flexroad.catalog import LAYERS, Catalog, Grid, Layer, Tile
from flexroad.catalog.crs import compound
from flexroad.catalog.crs_checks import require_scale
from flexroad.catalog.scan.cell_values import height_share
from flexroad.catalog.scan.rasters import opened, zoned
from flexroad.catalog.scan.vectors import VectorFile, with_roads
from flexroad.catalog.skipped import lines
from flexroad.catalog.storage.outputs import output_file
from flexroad.catalog.text import some
from flexroad.catalog.tile import HEIGHTS, MIN_COVER, ROAD_HEIGHT_BANDS
from flexroad.catalog.tiling import cut
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.execute import Executor, SerialExecutor
from flexroad.tasks.types import Orthophoto
from flexroad.tools.prepare.output import (
    CATALOG,
    LAYER_TAG,
    NAMES,
    disk_errors,
    on_failure,
    scratch_folder,
    write_error,
)

SERIAL = SerialExecutor()
PHOTO = "dop"
UNFINISHED = ".tmp.tif"
"""Ending of a layer's file until it is converted."""
BLOCK = 256
"""Side of the internal tiles of the temporary GeoTIFFs (cells)."""
HEIGHT_PROFILE = {"dtype": "float32", "nodata": np.nan, "count": 1}
ROAD_HEIGHT_PROFILE = {**HEIGHT_PROFILE, "count": len(ROAD_HEIGHT_BANDS)}
MASK_PROFILE = {"dtype": "uint8", "nodata": None, "count": 1}
PHOTO_PROFILE = {"dtype": "uint8", "nodata": None, "count": 3, "photometric": "RGB", "interleave": "pixel"}


@dataclass(frozen=True)
class PreparedDataset:
    """The result of a ``prepare`` command: rasters and their catalog."""

    catalog: Path
    """The catalog file, ``.parquet``."""
    tiles: int
    """Number of tiles in the catalog."""
    notes: tuple[str, ...] = ()
    """Notes on data that was left out or assumed, one line each."""

    def with_notes(self, *notes: str) -> PreparedDataset:
        """Return a copy with more notes in front."""
        return replace(self, notes=(*notes, *self.notes))


class RasterWriter:
    """Writer of the rasters of one area; a context manager that removes its temporary files.

    - `dop_cell`: pixel of the orthophoto (m); None without an orthophoto.
    - `vertical`: vertical CRS of the heights, in metres, if it is known.
    """

    def __init__(
        self,
        out: Path,
        grid: Grid,
        dop_cell: float | None,
        tags: Mapping[str, str],
        vertical: str | None = None,
    ) -> None:
        require_scale("the rasters", grid.crs, grid.bounds, "give a CRS in metres with --to-crs {zone}")
        self.out = out
        self.grid = grid
        self.photo_grid = Grid.covering(grid.crs, grid.bounds, dop_cell) if dop_cell else None
        self.tags = dict(tags)
        self._crs_of_heights = compound(grid.crs, vertical) if vertical else grid.crs
        self._open: dict[str, Any] = {}
        self._roads: list[VectorFile] = []
        self._notes: list[str] = []
        self.scratch = out
        """Folder for temporary files, also for the caller; made and removed with the context."""
        self._stack = contextlib.ExitStack()
        for name in NAMES:
            # Refused at the start and not after the rasters are computed.
            with disk_errors(out / name):
                output_file(out / name)

    def __enter__(self) -> Self:
        self.scratch = self._stack.enter_context(scratch_folder(self.out))
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for raster in self._open.values():
            with contextlib.suppress(RasterioError, OSError):
                raster.close()
        self._stack.close()

    def write(self, layer: str, part: Grid, values: NDArray[Any]) -> None:
        """Write a window of a layer: heights (m; NaN where unknown) or a mask, ``(H, W)``.

        The window of ``road_height`` has all bands, ``(3, H, W)``.
        """
        heights = layer in HEIGHTS
        with self._writing(layer):
            profile = HEIGHT_PROFILE if heights else MASK_PROFILE
            if layer == "road_height":
                profile = ROAD_HEIGHT_PROFILE
            raster = self._raster(layer, self.grid, profile)
            cells = values.astype(np.float32 if heights else np.uint8)
            bands = cells if cells.ndim > 2 else cells[None]
            raster.write(bands, window=_window(self.grid, part))

    def write_photo(self, photo: Orthophoto) -> None:
        """Write a window of the orthophoto; pixels without a colour are masked."""
        if self.photo_grid is None:
            raise ConfigError(f"no orthophoto was requested in {self.out}")
        with self._writing(PHOTO), rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True):
            raster = self._raster(PHOTO, self.photo_grid, PHOTO_PROFILE)
            window = _window(self.photo_grid, photo.grid)
            raster.write(photo.colour, window=window)
            raster.write_mask(photo.known, window=window)

    def attach_roads(self, file: VectorFile, *notes: str) -> None:
        """Add a vector file to the catalog as the roads of the tiles it overlaps; the file is not copied."""
        self._roads.append(file)
        self._notes += notes

    def read(self, layer: str, part: Grid) -> NDArray[Any]:
        """Return a window of a layer as written up to now, ``(H, W)``: float64 heights or a bool mask."""
        values: NDArray[Any] = self._open[layer].read(1, window=_window(self.grid, part))
        return values.astype(np.float64) if layer in HEIGHTS else values.astype(bool)

    def publish(
        self,
        tile_size_m: float = 250,
        date: datetime | None = None,
        dataset: str = "",
        min_cover: float = MIN_COVER,
        assumed: datetime | None = None,
        executor: Executor = SERIAL,
    ) -> PreparedDataset:
        """Convert the rasters to COGs and write the catalog; existing outputs in the folder are replaced.

        - `tile_size_m`: side of a tile (m). A smaller area is a single tile; a larger area is divided at
          multiples of it.
        - `date`: acquisition date; None: ``assumed`` is used, with a note.
        - `dataset`: name of the data in reports.
        - `min_cover`: tiles with heights in less than this share (0 to 1) of their cells are left out.
        - `assumed`: time when the source was written, with a time zone; None: now.
        - `executor`: converts each layer by a worker call.
        """
        names = [layer for layer in LAYERS if layer in self._open]
        for layer in names:
            with self._writing(layer):
                self._open[layer].close()
        # The largest layers first, so that no worker starts a large layer at the end.
        files = sorted((self._file(layer) for layer in names), key=lambda file: -file.stat().st_size)
        for file in executor.map(_to_cog, files, on_failure(_published)):
            file.unlink()
        survey = zoned(date or assumed or datetime.now(UTC))
        tiles, notes = self._tiles(names, tile_size_m, survey, dataset, min_cover)
        tiles = tuple(replace(tile, datetime_assumed=date is None) for tile in tiles)
        tiles, far = with_roads(tiles, self._roads, None)
        # A catalog must exist only next to complete rasters: it is removed first and written last.
        for name in NAMES:
            output_file(self.out / name).unlink(missing_ok=True)
        for layer in names:
            (self.scratch / f"{layer}.tif").replace(output_file(self.out / f"{layer}.tif"))
        Catalog(tiles).write(self.out / CATALOG)
        undated = (
            f"the date of the survey is not known: {survey:%Y-%m-%d}, when its files were written, is used "
            "instead (--date sets it)"
        )
        notes = (*self._notes, *notes, *lines(far), *([undated] if date is None else []))
        return PreparedDataset(self.out / CATALOG, len(tiles), notes)

    def _tiles(
        self, names: list[str], size_m: float, date: datetime, dataset: str, min_cover: float
    ) -> tuple[tuple[Tile, ...], tuple[str, ...]]:
        """Return the tiles with enough heights, and notes on the others."""
        if max(self.grid.width, self.grid.height) * self.grid.cell <= size_m:
            tiles: tuple[Tile, ...] = (self._one_tile(names, date, dataset),)
            notes: tuple[str, ...] = ()
        else:
            root = self.scratch.resolve()
            layers = {name: opened(root, name, [root / f"{name}.tif"], None)[0] for name in names}
            indexed = cut(root, layers, tile_size_m=size_m, date=date, dataset=dataset, min_cover=0)
            tiles = tuple(replace(tile, root=str(self.out.resolve())) for tile in indexed.tiles)
            notes = indexed.notes
        shares = (height_share(tile.grid, [self.scratch / "dsm.tif"]) or 0.0 for tile in tiles)
        enough = [share >= max(min_cover, 1e-9) for share in shares]
        kept = tuple(compress(tiles, enough))
        sparse = [tile.id for tile, is_kept in zip(tiles, enough, strict=True) if not is_kept]
        if not kept:
            raise ConfigError(
                f"no tile of {self.out} would have heights in {min_cover:.0%} of its cells; "
                "use larger cells (--cell) or smaller tiles (--tile-size)"
            )
        left_out = f"left out {some(sparse)}: heights in less than {min_cover:.0%} of the cells"
        return kept, (*notes, left_out) if sparse else notes

    def _one_tile(self, names: list[str], date: datetime, dataset: str) -> Tile:
        return Tile(
            id=f"{self.grid.west:.0f}_{self.grid.south:.0f}",
            grid=self.grid,
            layers=tuple(Layer(name, (f"{name}.tif",), extents=(self.grid.bounds,)) for name in names),
            root=str(self.out.resolve()),
            datetime=date,
            dataset=dataset,
        )

    def _raster(self, layer: str, grid: Grid, profile: Mapping[str, Any]) -> Any:
        if layer not in self._open:
            raster = rasterio.open(
                self._file(layer),
                "w+",
                driver="GTiff",
                crs=self._crs_of_heights if layer in HEIGHTS else grid.crs,
                transform=grid.transform,
                width=grid.width,
                height=grid.height,
                tiled=True,
                blockxsize=BLOCK,
                blockysize=BLOCK,
                BIGTIFF="IF_SAFER",
                **profile,
            )
            raster.update_tags(**self.tags, **{LAYER_TAG: layer})
            if layer == "road_height":
                raster.descriptions, raster.units = zip(*ROAD_HEIGHT_BANDS, strict=True)
            self._open[layer] = raster
        return self._open[layer]

    def _file(self, layer: str) -> Path:
        return self.scratch / f"{layer}{UNFINISHED}"

    def _writing(self, layer: str) -> contextlib.AbstractContextManager[None]:
        return _raster_errors(self.out / f"{layer}.tif")


@contextlib.contextmanager
def _raster_errors(where: Path) -> Iterator[None]:
    """Context manager that turns errors of writing a raster into a `ConfigError` of one line."""
    try:
        yield
    except CRSError as error:
        raise ConfigError(f"cannot write {where}: {error}; choose another CRS with --to-crs") from error
    except (OSError, RasterioError) as error:
        raise write_error(where, error) from error


def _to_cog(source: Path) -> Path:
    """Convert a layer to a COG in the same folder; return the layer's file."""
    layer = source.name.removesuffix(UNFINISHED)
    smooth = layer in HEIGHTS or layer == PHOTO
    with _raster_errors(_published(source)):
        rasterio.shutil.copy(
            source,
            source.with_name(f"{layer}.tif"),
            driver="COG",
            compress="deflate",
            # The default, 6, takes 1.4 times as long; the files are 2% smaller.
            level=1,
            predictor="floating_point" if layer in HEIGHTS else "standard",
            overview_resampling="average" if smooth else "mode",
            statistics="yes",
            bigtiff="if_safer",
        )
    return source


def _published(source: Path) -> Path:
    """Return the published file of a layer, from its file in the temporary folder."""
    return source.parents[1] / f"{source.name.removesuffix(UNFINISHED)}.tif"


def _window(whole: Grid, part: Grid) -> Window:
    rows, cols = whole.window(part)
    return Window.from_slices(rows, cols)
