"""A run in a notebook: its tiles, its tables, and heights and rasters of its finished tiles."""

from __future__ import annotations

import io
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, cast

import numpy as np
import shapely
from numpy.typing import ArrayLike

from flexroad.catalog import Bounds, Grid
from flexroad.catalog.grid import overlap
from flexroad.catalog.lazy import lazy
from flexroad.catalog.storage.paths import exists, read
from flexroad.catalog.text import access_reason, count, with_formula
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.graph.borders import has_borders
from flexroad.pipeline.run.api import Workers, process, reopened
from flexroad.pipeline.run.events import Observer
from flexroad.pipeline.run.finished import FinishedTile, open_variant
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.run.sampler import Answer, RunSampler
from flexroad.pipeline.run.status import peek_statuses
from flexroad.pipeline.store.tables import read_metrics
from flexroad.tasks import sample
from flexroad.tasks.spline.stepped import SteppedSurface
from flexroad.tasks.spline.surface import NurbsSurface, uniform_knots
from flexroad.tasks.types import Floats
from flexroad.tools.lift.driver import LiftedFile, lift
from flexroad.tools.lift.types import Options
from flexroad.tools.results.mosaic import mosaic
from flexroad.tools.results.surface import Surface, placed

if TYPE_CHECKING:
    import geopandas
    import pandas as pd
    import xarray as xr
else:
    geopandas, pd, xr = lazy("geopandas"), lazy("pandas"), lazy("xarray")

HEIGHTS = {"units": "m"}


@dataclass(frozen=True, eq=False, repr=False)
class RunView:
    """A view of a run, opened by `flexroad.open_run`; only `rerun` changes the run.

    Each access reads the current files of the run, also while the run is in progress.
    """

    run: Run
    """The opened run folder."""
    variant: str
    """The variant whose surfaces are used."""
    allow: tuple[str | Path, ...] = ()
    """Further folders that the sources of the run may lie below."""

    def __repr__(self) -> str:
        counts = self.tiles["state"].value_counts()
        states = ", ".join(f"{counts[state]} {state}" for state in counts.index)
        return (
            f"<flexroad.RunView: {self.run.path}>\n"
            f"config {self.run.config.name}, variant {self.variant}\n"
            f"{count(len(self.run.catalog.tiles), 'tile')}: {states}"
        )

    @property
    def tiles(self) -> geopandas.GeoDataFrame:
        """The tiles of the run.

        Returns
        -------
        geopandas.GeoDataFrame
            One row per tile: ``id``; ``state``, which is ``done``, ``failed`` or ``pending`` (not computed,
            or its sources or options have changed); ``geometry``, its outline in the CRS of the tiles (none
            if its entry in the catalog cannot be used).

        Examples
        --------
        >>> import flexroad
        >>> flexroad.open_run("runs/city").tiles[["id", "state"]]
                       id    state
        0  499980_5599980     done
        1  500040_5599980  pending
        """
        tiles = self.run.catalog.tiles
        states = [
            "done" if status.done else "failed" if status.failed else "pending"
            for status in peek_statuses(self.run, tiles)
        ]
        usable = self.run.catalog.usable
        return geopandas.GeoDataFrame(
            {"id": [tile.id for tile in tiles], "state": states},
            geometry=[None if tile.fault else shapely.box(*tile.grid.bounds) for tile in tiles],
            crs=usable[0].grid.crs if usable else None,
        )

    @property
    def metrics(self) -> pd.DataFrame:
        """The metrics in ``metrics.parquet``: one row per tile and variant.

        Raises
        ------
        ConfigError
            If the file does not exist yet or is damaged.

        Examples
        --------
        >>> import flexroad
        >>> flexroad.open_run("runs/city").metrics[["tile_id", "variant", "l2_road_m"]].round(2)
                  tile_id   variant  l2_road_m
        0  499980_5599980  flexroad       0.02
        """
        return read_metrics(self.run.path)

    @property
    def failures(self) -> pd.DataFrame:
        """The failures in ``failures.csv``: one row per failure.

        Returns
        -------
        pandas.DataFrame
            ``tile_id``, ``stage``, ``kind`` (the type of the error), ``message`` and ``file``, the source
            file at fault; no rows if nothing failed.

        Raises
        ------
        ConfigError
            If the file does not exist yet or is damaged.

        Examples
        --------
        >>> import flexroad
        >>> len(flexroad.open_run("runs/city").failures)
        0
        """
        path = self.run.path / "failures.csv"
        if not exists(path):
            raise ConfigError(f"{path} does not exist; `flexroad rerun {self.run.path}` finishes the run")
        try:
            table = pd.read_csv(io.BytesIO(read(path)), dtype=str, keep_default_na=False)
            return table.map(with_formula)
        except (OSError, ValueError) as error:
            if why := access_reason(error):
                raise ConfigError(f"{path} {why}") from error
            raise ConfigError(f"{path} is damaged: {error}; run `flexroad rerun {self.run.path}`") from error

    def height(self, x: ArrayLike, y: ArrayLike, level: int | None = None) -> Floats:
        """Return the height at points, with the steps beside roads.

        Parameters
        ----------
        x, y : array_like
            Eastings and northings (m) in the CRS of the tiles, of shapes that broadcast.
        level : int, optional
            The level of roads above roads (``segment.levels``): 0 is the ground with its streets, 1 a deck
            above it, -1 a tunnel below it; NaN where a point lacks the level. By default the highest.

        Returns
        -------
        ndarray
            Heights (m) in the broadcast shape; NaN off the finished tiles and beyond the survey.

        Raises
        ------
        ConfigError
            If a result of a tile is missing from the store and cannot be computed.

        Examples
        --------
        >>> import flexroad
        >>> flexroad.open_run("runs/city").height([500010.0, 500050.0], 5600030.0).round(1)
        array([151.3,   nan])
        """
        shape, answer = self._at(x, y, level)
        return answer.height.reshape(shape)[()]

    def normal(self, x: ArrayLike, y: ArrayLike) -> Floats:
        """Return the upward unit normal of the spline at points, without the steps beside roads.

        Parameters
        ----------
        x, y : array_like
            Eastings and northings (m) in the CRS of the tiles, of shapes that broadcast.

        Returns
        -------
        ndarray, (..., 3)
            East, north and up components; NaN off the finished tiles and beyond the survey.

        Raises
        ------
        ConfigError
            If a result of a tile is missing from the store and cannot be computed.

        Examples
        --------
        >>> import flexroad
        >>> flexroad.open_run("runs/city").normal(500010.0, 5600030.0).round(2)
        array([-0.03,  0.01,  1.  ])
        """
        shape, answer = self._at(x, y)
        return answer.normal.reshape(*shape, 3)

    def lift(
        self,
        path: str | Path,
        out: str | Path,
        options: Options | None = None,
        crs: str | None = None,
        report: str | Path | None = None,
    ) -> LiftedFile:
        """Write a road network or features of other programs with the heights of the run.

        Parameters
        ----------
        path, out : str or Path
            The file and its copy, both in one of the formats that ``flexroad lift --help`` names. Only the
            heights differ.
        options : flexroad.tools.lift.types.Options, optional
            Tolerance, cross-sections of roads, rows of the report.
        crs : str, optional
            CRS of the file, if the file has none.
        report : str or Path, optional
            A CSV with a row per road or feature.

        Returns
        -------
        LiftedFile
            ``rows``, one per road or feature, with its distances from the surface, and ``summary``.

        Raises
        ------
        ConfigError
            If the file cannot be read, is of an unknown format, has no CRS, or does not lie on the tiles.

        Examples
        --------
        >>> import flexroad
        >>> run = flexroad.open_run("runs/city")
        >>> run.lift("streets.osm", "streets_3d.osm").summary        # doctest: +SKIP
        '30 features, 2.41 km'
        """
        ground = RunSampler(self.run, self.variant)
        table = None if report is None else Path(report)
        return lift(ground, Path(path), Path(out), options or Options(), crs, report=table)

    def to_xarray(self, bounds: Bounds | None = None) -> xr.Dataset:
        """Return height and road mask of the finished tiles as one lazy raster.

        Parameters
        ----------
        bounds : tuple of float, optional
            West, south, east, north (m), extended to whole cells; by default the bounds of all tiles.

        Returns
        -------
        xarray.Dataset, (y, x)
            ``height`` (m, float32; NaN off the finished tiles and beyond the survey) and ``road`` (bool, the
            filtered mask), backed by Dask: one chunk per tile, read from the tile's GeoTIFF when it is
            computed. Coordinates ``x`` (ascending) and ``y`` (descending) are eastings and northings (m);
            ``.rio.crs`` is set. Where tiles overlap, the first tile in the catalog is used.

        Raises
        ------
        ConfigError
            If the bounds are empty, the run does not export GeoTIFF (``cog``), or its tiles have different
            cell sizes or lattices.

        Examples
        --------
        >>> import flexroad
        >>> raster = flexroad.open_run("runs/city").to_xarray((500000, 5600000, 500060, 5600030))
        >>> dict(raster.sizes), dict(raster.chunksizes)
        ({'y': 30, 'x': 60}, {'y': (30,), 'x': (40, 20)})
        >>> bool(raster.height.isnull().sum() == 20 * 30)
        True
        """
        exported = self.run.config.export
        if "cog" not in exported.formats or self.variant not in exported.variants:
            raise ConfigError(
                f"{self.run.path} exports no GeoTIFF of {self.variant}; add cog to export.formats and rerun"
            )
        raster, grid = mosaic(self.run, self.variant, bounds)
        return placed(raster, grid.crs, grid.transform)

    def surface(self, bounds: Bounds | None = None) -> Surface:
        """Return the surface of several finished tiles as one, with one lattice of control points.

        Parameters
        ----------
        bounds : tuple of float, optional
            West, south, east, north (m); the surface has all tiles that reach into them. By default all.

        Returns
        -------
        Surface
            Equal to the surfaces of its tiles, with the steps beside roads, except for rounding (below
            1e-9 m), see docs/mosaic.md. NaN in tiles that are not finished, and on their edges. It has no
            road mask and no mesh, and continues beyond the survey.

        Raises
        ------
        ConfigError
            If there is no finished tile in the bounds, or the tiles have no common lattice: only the method
            ``smoothing_spline`` fits one surface; or one of them has decks or tunnels (``segment.levels``).

        Examples
        --------
        >>> import flexroad
        >>> run = flexroad.open_run("runs/city")
        >>> surface = run.surface()
        >>> surface
        <flexroad.Surface: stepped of 20 x 20 control points>
        EPSG:25832, 60 x 60 m, bounds 499980 5599980 500040 5600040
        road: unknown
        >>> bool(abs(surface.height(500010.0, 5600030.0) - run.height(500010.0, 5600030.0)) < 1e-9)
        True
        """
        fit = self.run.config.chains[self.variant]["fit"]
        if not has_borders(fit):
            raise ConfigError(
                f"{self.run.path}: the tiles of {self.variant} have no common surface; fit.method "
                "smoothing_spline makes one. The heights of single tiles are in open_run(...).height"
            )
        tiles = [
            tile for tile in self.run.catalog.usable if bounds is None or overlap(tile.grid.bounds, bounds)
        ]
        done = [status for status in peek_statuses(self.run, tiles) if status.done]
        if not done:
            raise ConfigError(
                f"{self.run.path} has no finished tile in {bounds or 'its catalog'}; see `flexroad status`"
            )
        surfaces = _of_one_level(FinishedTile.of(self.run, status, self.variant) for status in done)
        grids = [status.graph.tile.grid for status in done]
        whole = _joined(grids, surfaces)
        west, south, east, north = whole.bounds
        if bounds is not None:
            west, south = max(west, bounds[0]), max(south, bounds[1])
            east, north = min(east, bounds[2]), min(north, bounds[3])
        return Surface(whole, whole.crs, (west, south, east, north), None, None, sample.Options(), "")

    def tile(self, tile_id: str) -> xr.Dataset:
        """Return the input rasters, masks and fitted surface of one tile.

        Parameters
        ----------
        tile_id : str
            An ``id`` of `tiles`.

        Returns
        -------
        xarray.Dataset, (y, x)
            ``dsm``, ``dtm``, ``surface`` (m; with levels, the surface of level 0), ``road``,
            ``road_filtered`` and, where the catalog has them, ``reference`` (m) and ``reference_road``.

        Raises
        ------
        ConfigError
            If a stage fails on the tile.
        CatalogError
            If there is no such tile.

        Examples
        --------
        >>> import flexroad
        >>> tile = flexroad.open_run("runs/city").tile("499980_5599980")
        >>> float(abs(tile.surface - tile.reference).where(tile.road).mean().round(1))
        0.0
        """
        (tile,) = self.run.catalog.select([tile_id]).tiles
        (status,) = peek_statuses(self.run, [tile])
        results = FinishedTile.of(self.run, status, self.variant)
        data, road, clusters, surface = results.data, results.road, results.clusters, results.surface
        core, window = data.core, data.grid.window(data.core)
        rasters = {name: getattr(data, name) for name in ("dsm", "dtm", "reference", "reference_road")}
        rasters |= {"road": road.mask, "road_filtered": clusters.mask}
        cut = {name: raster[window] for name, raster in rasters.items() if raster is not None}
        cut["surface"] = surface.lattice(core.eastings, core.northings)
        dataset = xr.Dataset(
            {
                name: (("y", "x"), raster, {} if raster.dtype == bool else HEIGHTS)
                for name, raster in cut.items()
            },
            coords={"x": core.eastings, "y": core.northings},
            attrs={"tile": tile.id, "variant": self.variant, "stratum": tile.stratum},
        )
        return placed(dataset, core.crs)

    def rerun(
        self,
        tiles: Sequence[str] = (),
        *,
        failed: bool = False,
        from_stage: str | None = None,
        workers: int | None = None,
        observer: Observer | None = None,
    ) -> RunView:
        """Bring tiles up to date again, as ``flexroad rerun`` does.

        Parameters
        ----------
        tiles : sequence of str
            Ids of the tiles; empty: all tiles, or the failed tiles.
        failed : bool
            Whether the failed tiles are processed, besides the given ones.
        from_stage : str, optional
            Stage to compute again, with all later ones; ``export``: only the products are written again.
        workers : int, optional
            Most worker processes; 1: this process alone; None: as many as save time.
        observer : Observer, optional
            Takes the events of the run.

        Returns
        -------
        RunView
            The run after that.

        Raises
        ------
        ConfigError, CatalogError, ClusterLost, OSError
            As in `flexroad.run`.

        Examples
        --------
        >>> import flexroad
        >>> run = flexroad.open_run("runs/city")
        >>> run.rerun(["499980_5599980"], from_stage="export", workers=1).tiles["state"].tolist()
        ['done', 'pending']
        """
        held = reopened(
            self.run.path,
            tiles,
            failed=failed,
            from_stage=from_stage,
            allow=self.allow,
            workers=Workers("serial" if workers == 1 else "auto", workers),
            observer=observer,
        )
        with held as prepared:
            process(prepared)
        return open_run(str(self.run.path), self.variant, self.allow)

    def _at(self, x: ArrayLike, y: ArrayLike, level: int | None = None) -> tuple[tuple[int, ...], Answer]:
        easting, northing = np.broadcast_arrays(np.asarray(x, np.float64), np.asarray(y, np.float64))
        return easting.shape, RunSampler(self.run, self.variant).at(easting.ravel(), northing.ravel(), level)


def open_run(path: str | Path, variant: str | None = None, allow: Sequence[str | Path] = ()) -> RunView:
    """Open a run, finished or in progress.

    Parameters
    ----------
    path : str or Path
        The folder given to ``flexroad run --out``, or its address in object storage (``s3://...``).
    variant : str, optional
        The variant whose surfaces are used; by default the first exported variant.
    allow : sequence of str or Path
        Further folders that the sources of the run may lie below. Needed for runs of another user, or of
        another machine, with sources outside the run's folder.

    Raises
    ------
    ConfigError
        If the folder is not a run, or has no such variant.
    CatalogError
        If its catalog is damaged, or later if a source lies outside the allowed folders.

    Examples
    --------
    >>> import flexroad
    >>> flexroad.open_run("runs/city")
    <flexroad.RunView: runs/city>
    config production, variant flexroad
    2 tiles: 1 done, 1 pending
    """
    return RunView(*open_variant(path, variant, allow), tuple(allow))


def _of_one_level(tiles: Iterable[FinishedTile]) -> Iterator[NurbsSurface]:
    """Yield the surfaces of tiles. A tile with levels raises an error: it has several surfaces."""
    for tile in tiles:
        surface = tile.surface
        if surface.levels:
            raise ConfigError(
                f"tile {tile.id} has roads above roads, which are no single surface: give bounds without it; "
                "open_run(...).height(x, y, level=0) has its ground"
            )
        yield cast("NurbsSurface", surface)


def _joined(grids: Sequence[Grid], surfaces: Iterable[NurbsSurface]) -> NurbsSurface:
    """Return one surface over the rectangle around the tiles; NaN where it has no tile."""
    if len({grid.crs for grid in grids}) > 1:
        raise ConfigError("the tiles are in different CRS; give bounds with tiles of one CRS")
    cells = Grid.holding(grids)
    if cells is None:
        raise ConfigError("the tiles have no common lattice; give bounds with tiles of one lattice")
    first, surfaces = grids[0], iter(surfaces)
    spline = next(surfaces)
    (p, q), (height, width) = spline.degree, first.shape
    n, m = spline.A.shape[1] - p, spline.A.shape[0] - q
    columns, rows = round(cells.width / width), round(cells.height / height)
    heights, steps = np.full((rows * m + q, columns * n + p), np.nan), np.zeros(cells.shape, np.float32)
    south_north = np.zeros((rows + 1, cells.width), np.float32)
    west_east = np.zeros((columns + 1, cells.height), np.float32)
    stepped = False
    for grid, surface in zip(grids, chain([spline], surfaces), strict=True):
        window = down, along = cells.window(grid)
        i, j = along.start // width, rows - 1 - down.start // height
        # Points and steps on the border are in both tiles; they stay if the neighbour is missing.
        heights[j * m : (j + 1) * m + q, i * n : (i + 1) * n + p] = surface.A
        if isinstance(surface, SteppedSurface):
            stepped, steps[window] = True, surface.steps
            south_north[j : j + 2, along], west_east[i : i + 2, down] = surface.south_north, surface.west_east
    whole = NurbsSurface(
        crs=first.crs,
        bounds=cells.bounds,
        degree=(p, q),
        knots_u=uniform_knots(0, columns * n, p),
        knots_v=uniform_knots(0, rows * m, q),
        A=heights,
        W=np.ones_like(heights),
        datum=spline.datum,
        origin=(float(np.floor(cells.west)), float(np.floor(cells.south))),
    )
    if not stepped:
        return whole
    return SteppedSurface(
        **vars(whole), steps=steps, cells=cells, south_north=south_north, west_east=west_east
    )
