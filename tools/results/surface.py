"""A fitted surface in a notebook: fit in memory, heights, normals, rasters, a mesh, and one file."""

from __future__ import annotations

import contextlib
import io
import warnings
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import astuple, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from affine import Affine
from numpy.typing import ArrayLike
from threadpoolctl import threadpool_limits

from flexroad.catalog import Bounds, Grid
from flexroad.catalog.lazy import lazy
from flexroad.catalog.storage.outputs import atomic_path
from flexroad.catalog.storage.scratch import ScratchFolder
from flexroad.catalog.text import reason
from flexroad.pipeline.config.loading import load_config
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.graph.borders import has_borders
from flexroad.tasks import sample, types
from flexroad.tasks.border import BorderStages
from flexroad.tasks.errors import TaskError
from flexroad.tasks.options import Options, stage_function
from flexroad.tasks.products import npz
from flexroad.tasks.quality.assess import NO_ROAD
from flexroad.tasks.segment import mask, vector
from flexroad.tasks.spline.frame import Frame
from flexroad.tasks.spline.surface import NurbsSurface
from flexroad.tasks.types import Bools, Floats, RoadClusters, RoadMask, Source
from flexroad.tools.results.load_arrays import load_arrays

if TYPE_CHECKING:
    import geopandas
    import rioxarray
    import trimesh
    import xarray as xr
else:
    geopandas, rioxarray = lazy("geopandas"), lazy("rioxarray")
    trimesh, xr = lazy("trimesh"), lazy("xarray")

AXES = {"z": "x east, y north, z up", "y": "x east, y up, z south"}
"""Directions of the mesh axes by the upward axis."""


@dataclass(frozen=True, eq=False, repr=False)
class Surface:
    """The fitted surface of one area; returned by `flexroad.fit` and `flexroad.open_surface`.

    Examples
    --------
    >>> import flexroad
    >>> scene = flexroad.example(size_m=60)
    >>> surface = flexroad.fit(scene.dsm, scene.dtm, scene.road_mask)
    >>> surface.crs, surface.bounds
    ('EPSG:25832', (500200.0, 5600000.0, 500260.0, 5600060.0))
    """

    fitted: types.Surface
    """The result of the stage ``fit``: a `NurbsSurface`, a plane or a raster."""
    crs: str
    """CRS of x and y: ``EPSG:25832``, or WKT if there is no code."""
    bounds: Bounds
    """West, south, east, north (m)."""
    road: RoadMask | None
    """The road mask before the filter, on the grid with its halo; None if read from a file of a run."""
    clusters: RoadClusters | None
    """The road clusters that the filter kept; None if read from a file of a run."""
    sampling: sample.Options
    """Options of the sampling in `to_mesh`."""
    config: str
    """Name of the configuration of the fit; empty if unknown."""

    def __repr__(self) -> str:
        west, south, east, north = (f"{edge:.10g}" for edge in self.bounds)
        kind = type(self.fitted).__name__.removesuffix("Surface").lower()
        if isinstance(self.fitted, NurbsSurface):
            rows, columns = self.fitted.A.shape
            kind = f"{kind} of {columns} x {rows} control points"
        size = f"{self.bounds[2] - self.bounds[0]:g} x {self.bounds[3] - self.bounds[1]:g} m"
        crs = self.crs if len(self.crs) < 40 else f"{self.crs[:40]}..."
        road = "road: unknown"
        if self.road is not None and self.clusters is not None:
            given, kept = (_cut(mask, self.road).sum() for mask in (self.road.mask, self.clusters.mask))
            road = f"road: {given} cells given, {kept} kept by the filter"
            road += f"; {', '.join(self.flags)}" if self.flags else ""
        return (
            f"<flexroad.Surface: {kind}{f', config {self.config}' if self.config else ''}>\n"
            f"{crs}, {size}, bounds {west} {south} {east} {north}\n{road}"
        )

    @property
    def flags(self) -> tuple[str, ...]:
        """``("no-road",)`` if no road cell is left after the filter: the surface is the terrain's.

        Empty if a road cell is left, or if the surface has no mask.

        Examples
        --------
        >>> import flexroad
        >>> scene = flexroad.example(size_m=60)
        >>> flexroad.fit(scene.dsm, scene.dtm, scene.road_mask).flags
        ()
        """
        if self.road is None or self.clusters is None:
            return ()
        return () if _cut(self.clusters.mask, self.road).any() else (NO_ROAD,)

    def height(self, x: ArrayLike, y: ArrayLike) -> Floats:
        """Return the height at points.

        Parameters
        ----------
        x, y : array_like
            Eastings and northings (m) in `crs`, of shapes that broadcast.

        Returns
        -------
        ndarray
            Heights (m) in the broadcast shape; NaN outside `bounds` and where the survey has no data.

        Examples
        --------
        >>> import flexroad
        >>> scene = flexroad.example(size_m=60)
        >>> surface = flexroad.fit(scene.dsm, scene.dtm, scene.road_mask)
        >>> surface.height([500210.0, 500220.0, 0.0], 5600030.0).round(1)
        array([152.4, 152.5,   nan])
        """
        easting, northing = np.broadcast_arrays(np.asarray(x, np.float64), np.asarray(y, np.float64))
        return np.where(self._valid(easting, northing), self.fitted.height(easting, northing), np.nan)[()]

    def normal(self, x: ArrayLike, y: ArrayLike) -> Floats:
        """Return the upward unit normal of the spline at points, without the steps beside roads.

        Parameters
        ----------
        x, y : array_like
            Eastings and northings (m) in `crs`, of shapes that broadcast.

        Returns
        -------
        ndarray, (..., 3)
            East, north and up components; NaN outside `bounds` and where the survey has no data.

        Examples
        --------
        >>> import flexroad
        >>> scene = flexroad.example(size_m=60)
        >>> surface = flexroad.fit(scene.dsm, scene.dtm, scene.road_mask)
        >>> surface.normal(500210.0, 5600030.0).round(2)
        array([-0.03, -0.04,  1.  ])
        """
        easting, northing = np.broadcast_arrays(np.asarray(x, np.float64), np.asarray(y, np.float64))
        valid = self._valid(easting, northing)[..., None]
        return np.where(valid, self.fitted.normal(easting, northing), np.nan)

    def to_xarray(self, resolution: float = 1.0) -> xr.Dataset:
        """Return heights and road mask on a grid of square cells over `bounds`.

        Parameters
        ----------
        resolution : float
            Cell size (m). The grid starts in the north-west corner.

        Returns
        -------
        xarray.Dataset, (y, x)
            ``height`` (m; NaN where the survey has no data) at the cell centres and, if there is a mask,
            ``road``: the filtered road mask at the nearest input cell. Coordinates ``x`` (ascending) and
            ``y`` (descending) are eastings and northings (m); ``.rio.crs`` is set.

        Raises
        ------
        ConfigError
            If the resolution is not a positive number.

        Examples
        --------
        >>> import flexroad
        >>> scene = flexroad.example(size_m=60)
        >>> surface = flexroad.fit(scene.dsm, scene.dtm, scene.road_mask)
        >>> raster = surface.to_xarray(resolution=0.5)
        >>> dict(raster.sizes), list(raster.data_vars), raster.rio.crs.to_epsg()
        ({'y': 120, 'x': 120}, ['height', 'road'], 25832)
        """
        if not 0 < resolution < np.inf:
            raise ConfigError(f"resolution {resolution:g} m is not a cell size; give a number above 0")
        grid = Grid.covering(self.crs, self.bounds, resolution)
        x, y = np.meshgrid(grid.eastings, grid.northings)
        heights = self.fitted.lattice(grid.eastings, grid.northings)
        valid = self._valid(x, y)
        heights[~valid] = np.nan
        layers: dict[str, Any] = {"height": (("y", "x"), heights, {"units": "m"})}
        if self.road is not None and self.clusters is not None:
            road = _cut(self.clusters.mask, self.road)[self.road.core.cells(x, y)]
            layers["road"] = ("y", "x"), road & valid
        raster = xr.Dataset(layers, coords={"x": grid.eastings, "y": grid.northings})
        return placed(raster, self.crs, grid.transform)

    def to_mesh(self, up: Literal["z", "y"] = "z") -> trimesh.Trimesh:
        """Return the surface as a triangle mesh, sampled with the options `sampling`.

        Parameters
        ----------
        up : {"z", "y"}
            The upward axis: z for CAD, PLY and OBJ, y for glTF (GLB).

        Returns
        -------
        trimesh.Trimesh
            Vertices (m) relative to a whole-metre origin, so that float32 formats keep millimetres.
            ``metadata`` has ``crs``, ``origin`` (easting, northing, height; m) and ``axes``;
            ``face_attributes["road"]``, (F,), is True for faces on the road.

        Raises
        ------
        ConfigError
            If the surface has no road mask, as it was read from a file of a run.

        Examples
        --------
        >>> import flexroad
        >>> scene = flexroad.example(size_m=60)
        >>> surface = flexroad.fit(scene.dsm, scene.dtm, scene.road_mask)
        >>> mesh = surface.to_mesh()
        >>> mesh.metadata["origin"]
        [500200.0, 5600000.0, 150.0]
        """
        if self.road is None or self.clusters is None:
            raise ConfigError(
                "the surface has no road mask, as it was read from a file of a run; use the mesh of the run"
            )
        mesh = sample.sample(self.fitted, self.road, self.clusters, self.sampling)
        east, north, height = mesh.vertices.T
        vertices = np.stack([east, height, -north], axis=1) if up == "y" else mesh.vertices
        metadata = {"crs": mesh.crs, "origin": [float(v) for v in mesh.origin], "axes": AXES[up]}
        return trimesh.Trimesh(
            vertices, mesh.faces, face_attributes={"road": mesh.road}, metadata=metadata, process=False
        )

    def save(self, path: str | Path) -> None:
        """Write the surface to one ``.npz`` file, for `flexroad.open_surface` or any NumPy.

        The file contains knots, coefficients and weights in float64, as the ``.npz`` files of a run do, and
        the road mask.

        Parameters
        ----------
        path : str or Path
            The file; its name should end in ``.npz``.

        Raises
        ------
        TaskError
            If the surface is a plane or a raster, which the format cannot store.

        Examples
        --------
        >>> import flexroad
        >>> scene = flexroad.example(size_m=60)
        >>> surface = flexroad.fit(scene.dsm, scene.dtm, scene.road_mask)
        >>> surface.save("road.npz")
        >>> bool(flexroad.open_surface("road.npz").height(500210, 5600030) == surface.height(500210, 5600030))
        True
        """
        if not isinstance(self.fitted, NurbsSurface):
            raise TaskError(
                f"a {type(self.fitted).__name__} is not a NURBS surface; save the result of to_xarray()"
            )
        buffer = io.BytesIO(npz.encode(self.fitted))
        if self.road is not None and self.clusters is not None:
            arrays: dict[str, Any] = {} if self.road.areas is None else {"areas": self.road.areas}
            arrays |= {
                "grid": np.asarray(astuple(self.road.grid)[1:], np.float64),
                "core": np.asarray(astuple(self.road.core)[1:], np.float64),
                "road_mask": self.road.mask,
                "outside": self.road.outside,
                "labels": self.clusters.labels,
                "sampling": np.array(self.sampling.model_dump_json()),
                "config": np.array(self.config),
            }
            with zipfile.ZipFile(buffer, "a", zipfile.ZIP_DEFLATED) as archive:
                for name, values in arrays.items():
                    with archive.open(f"{name}.npy", "w") as member:
                        np.lib.format.write_array(member, np.asarray(values), allow_pickle=False)
        with atomic_path(Path(path)) as temporary:
            temporary.write_bytes(buffer.getvalue())

    def _valid(self, easting: Floats, northing: Floats) -> Bools:
        """Return which points are inside the bounds and where the survey has data."""
        west, south, east, north = self.bounds
        inside: Bools = (west <= easting) & (easting <= east) & (south <= northing) & (northing <= north)
        if self.road is None:
            return inside
        return inside & ~_cut(self.road.outside, self.road)[self.road.core.cells(easting, northing)]


def fit(
    dsm: xr.DataArray,
    dtm: xr.DataArray,
    road_mask: xr.DataArray | geopandas.GeoDataFrame,
    config: str | Path = "production",
    variant: str | None = None,
    *,
    road_values: Sequence[int] = (),
    settings: Sequence[str] | Mapping[str, Any] = (),
) -> Surface:
    """Fit a smooth surface to the road and the terrain of one area.

    The stages and the result are the same as in a run. The area is fitted as one tile. This suits 60 m x 60 m
    to about 500 m x 500 m. For larger areas make a catalog and a run.

    Parameters
    ----------
    dsm : xarray.DataArray, (H, W)
        Digital surface model, heights in m. The surface has the same grid: square pixels, a projected CRS in
        metres (``dsm.rio.crs``), coordinates of the cell centres that ascend or descend. NaN and
        ``dsm.rio.nodata`` are nodata. Dask arrays are computed.
    dtm : xarray.DataArray, (H, W)
        Digital terrain model, heights in m, in the same CRS. If its cells do not coincide with the cells of
        the DSM, it is resampled bilinearly, with a warning.
    road_mask : xarray.DataArray, (H, W), or geopandas.GeoDataFrame
        Road where True, not 0, or one of ``road_values``, in the same CRS. If its cells do not coincide with
        the cells of the DSM, the nearest cell is taken, with a warning. It replaces the configuration's
        ``segment``. Or areas and centre lines of roads: ``segment: vector`` reads them with its options.
        If no road cell is left after the filter, the surface is the terrain's, as in a run, and has the flag
        ``no-road`` (`Surface.flags`). A warning is given for a mask without road cells, a mask that is all
        road, and several classes that all mean road.
    config : str or Path
        A shipped configuration (``production``, ``paper``) or a YAML file.
    variant : str, optional
        A variant of the configuration; by default the first exported variant.
    road_values : sequence of int
        Values of the road mask that mean road; empty: all except 0 and nodata.
    settings : sequence of str, or mapping
        Options of the configuration: ``["fit.spacing_m=5"]`` or ``{"fit": {"spacing_m": 5}}``.

    Returns
    -------
    Surface
        The fitted surface.

    Raises
    ------
    TaskError
        If an array has no CRS, is in degrees or feet, is rotated, or its pixels are not square; if two arrays
        differ in CRS; if the DSM has too few heights; if the mask has fractions, such as probabilities; if a
        stage fails.
    ConfigError
        If there is no such configuration, variant or setting.

    Examples
    --------
    >>> import flexroad
    >>> scene = flexroad.example(size_m=60)
    >>> surface = flexroad.fit(scene.dsm, scene.dtm, scene.road_mask)
    >>> surface
    <flexroad.Surface: stepped of 20 x 20 control points, config production>
    EPSG:25832, 60 x 60 m, bounds 500200 5600000 500260 5600060
    road: 1576 cells given, 1445 kept by the filter
    """
    chosen = load_config(config, settings)
    variant = variant or chosen.export.variants[0]
    if variant not in chosen.chains:
        raise ConfigError(f"{config} has no variant {variant!r}; it has {', '.join(chosen.chains)}")
    chain = chosen.chains[variant]
    # At these sizes several BLAS threads are much slower than one thread.
    with threadpool_limits(1), _layer(road_mask) as layer:
        data = load_arrays(dsm, dtm, layer, chain["load"], road_values)
        if data.roads and road_values:
            raise ConfigError("road_values are of a mask; select roads of a table with segment.where")
        segment = _segment(data, chain["segment"])
        road = stage_function("segment", segment)(data, segment)
        for note in (*data.notes, *(road.notes if data.roads else ())):
            warnings.warn(note, stacklevel=2)
        clusters = stage_function("ecsrc", chain["ecsrc"])(data, road, chain["ecsrc"])
        framed: dict[str, Frame] = {}
        # As in a run, the control points on the border are fitted first.
        if has_borders(chain["fit"]):
            stages = replace(BorderStages.of(chain), segment=segment)
            wide = chain["load"].model_copy(update={"halo_m": stages.reach_m})
            framed["frame"] = stages.frame(load_arrays(dsm, dtm, layer, wide, road_values), data.core)
        fitted = stage_function("fit", chain["fit"])(data, clusters, chain["fit"], **framed)
    return Surface(fitted, data.core.crs, data.core.bounds, road, clusters, chain["sample"], chosen.name)


@contextlib.contextmanager
def _layer(road_mask: xr.DataArray | geopandas.GeoDataFrame) -> Iterator[xr.DataArray | Source]:
    """Yield the mask, or the roads of a table as a layer in a temporary file."""
    if isinstance(road_mask, xr.DataArray) or not isinstance(road_mask, geopandas.GeoDataFrame):
        yield road_mask
        return
    if road_mask.crs is None:
        raise TaskError("the roads have no CRS; write it, e.g. roads.set_crs('EPSG:25832')")
    with ScratchFolder() as folder:
        path = Path(folder) / "roads.gpkg"
        try:
            road_mask.to_file(path, driver="GPKG")
        except (RuntimeError, TypeError, ValueError) as error:
            raise TaskError(
                f"the roads cannot be written as a GeoPackage: {reason(error)}; leave out other columns"
            ) from error
        yield Source("roads", (path,))


def _segment(data: types.TileData, options: Options) -> Options:
    """Return the options of the segmentation for the given roads: a mask, or vectors."""
    if data.roads is None:
        return mask.Options()
    of_vectors = options if isinstance(options, vector.Options) else vector.Options()
    if of_vectors.levels:
        raise ConfigError(
            "segment.levels gives several surfaces, fit one; make a catalog and a run for levels"
        )
    return of_vectors


def open_surface(path: str | Path) -> Surface:
    """Open a surface file written by `Surface.save` or by a run.

    Parameters
    ----------
    path : str or Path
        An ``.npz`` file, such as ``RUN/tiles/ID/ID_flexroad_surface.npz``. Files of a run contain no road
        mask: then the surface has heights and normals over its complete domain, but no mesh.

    Raises
    ------
    TaskError
        If the file is missing, damaged, not a surface, or of a later version.

    Examples
    --------
    >>> import flexroad
    >>> scene = flexroad.example(size_m=60)
    >>> flexroad.fit(scene.dsm, scene.dtm, scene.road_mask).save("road.npz")
    >>> flexroad.open_surface("road.npz").bounds
    (500200.0, 5600000.0, 500260.0, 5600060.0)
    """
    fitted = npz.decode(Path(path))
    try:
        with np.load(Path(path), allow_pickle=False) as archive:
            if "labels" not in archive.files:
                return Surface(fitted, fitted.crs, fitted.bounds, None, None, sample.Options(), "")
            grid, core = (_grid(fitted.crs, archive[name]) for name in ("grid", "core"))
            areas = archive["areas"] if "areas" in archive.files else None
            road = RoadMask(grid, core, archive["road_mask"], archive["outside"], areas=areas)
            clusters = RoadClusters(grid, archive["labels"])
            sampling = sample.Options.model_validate_json(str(archive["sampling"]))
            return Surface(fitted, core.crs, core.bounds, road, clusters, sampling, str(archive["config"]))
    except npz.DAMAGED as error:
        raise TaskError(f"{path}: its road mask is damaged ({error}); save it again", str(path)) from error


def placed(raster: xr.Dataset, crs: str, transform: Affine | None = None) -> xr.Dataset:
    """Return a raster with a CRS and, if it is given, a transform, as rioxarray reads them.

    Heights have NaN as nodata: programs that read them as GeoTIFF need this value.
    """
    result: xr.Dataset = rioxarray.raster_dataset.RasterDataset(raster).write_crs(crs)
    for name, layer in result.data_vars.items():
        if np.issubdtype(layer.dtype, np.floating):
            result[name] = layer.rio.write_nodata(np.nan, encoded=True)
    return result if transform is None else result.rio.write_transform(transform)


def _cut(values: Bools, road: RoadMask) -> Bools:
    """Return the part of a mask that lies on the core."""
    return values[road.grid.window(road.core)]


def _grid(crs: str, numbers: Floats) -> Grid:
    west, north, cell, width, height = map(float, numbers)
    return Grid(crs, west, north, cell, int(width), int(height))
