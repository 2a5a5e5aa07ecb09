"""``flexroad catalog``: make, show and check catalogs."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from flexroad.catalog.cover import MIN_COVER
from flexroad.pipeline.cli.command import MIN_COVER_HELP, Allow, Command
from flexroad.pipeline.cli.next_step import after_catalog
from flexroad.pipeline.cli.stdio import echo

if TYPE_CHECKING:
    from flexroad.catalog.tiling import TilingResult

catalogs = typer.Typer(no_args_is_help=True, help="Make, show and check catalogs of tiles.")

Output = Annotated[Path, typer.Option("-o", "--output", help="Catalog to write: .parquet or .json.")]
RoadValue = Annotated[
    list[int] | None, typer.Option(help="Values of the mask that mean road; default: all except 0.")
]
Roads = Annotated[
    str | None, typer.Option(help="Vector files of roads: a file, or a pattern relative to ROOT.")
]
TileSize = Annotated[float, typer.Option(help="Size of a tile in m.")]
MinCover = Annotated[float, typer.Option(min=0, max=1, help=MIN_COVER_HELP)]
Date = Annotated[datetime | None, typer.Option(help="Date of the survey.")]


@catalogs.command("rasters", cls=Command)
def catalog_rasters(
    root: Annotated[Path, typer.Argument(help="Folder of rasters.")],
    dsm: Annotated[str, typer.Option(help="Files of the surface model, relative to ROOT ('dsm/*.tif').")],
    dtm: Annotated[str, typer.Option(help="Files of the terrain model.")],
    output: Output,
    dop: Annotated[str | None, typer.Option(help="Files of the orthophoto.")] = None,
    road_mask: Annotated[str | None, typer.Option(help="Files of the road mask or land cover.")] = None,
    road_value: RoadValue = None,
    roads: Roads = None,
    reference: Annotated[
        str | None, typer.Option(help="Files of reference heights, for the evaluation.")
    ] = None,
    reference_road: Annotated[
        str | None, typer.Option(help="Files of the reference road mask, for the evaluation.")
    ] = None,
    tile_size: TileSize = 250,
    min_cover: MinCover = MIN_COVER,
    date: Date = None,
    crs: Annotated[str | None, typer.Option(help="CRS of files without one: EPSG:25832.")] = None,
    allow: Allow = None,
) -> None:
    """Cut folders of GeoTIFF, ASC, XYZ or VRT into tiles."""
    from flexroad.catalog.sources import rasters

    patterns = {
        "dsm": dsm,
        "dtm": dtm,
        "dop": dop,
        "road_mask": road_mask,
        "reference": reference,
        "reference_road": reference_road,
        "roads": roads,
    }
    result = rasters.index(
        root,
        {name: pattern for name, pattern in patterns.items() if pattern is not None},
        road_values=tuple(road_value or ()),
        tile_size_m=tile_size,
        date=date,
        crs=crs,
        min_cover=min_cover,
        allow=allow or (),
    )
    _write_catalog(result, output)


@catalogs.command("nrw", cls=Command)
def catalog_nrw(
    root: Annotated[Path, typer.Argument(help="Folder of Geobasis NRW downloads with their original names.")],
    output: Output,
    road_mask: Annotated[str | None, typer.Option(help="Files of the road mask or land cover.")] = None,
    road_value: RoadValue = None,
    roads: Roads = None,
    tile_size: TileSize = 250,
    min_cover: MinCover = MIN_COVER,
    date: Date = None,
    allow: Allow = None,
) -> None:
    """Cut downloads of Geobasis NRW (dom1_32_356_5699_1_nw_2020.tif, dgm1, dop, 3dm) into tiles."""
    from flexroad.catalog.sources import nrw

    result = nrw.index(
        root,
        road_mask=road_mask,
        road_values=tuple(road_value or ()),
        tile_size_m=tile_size,
        date=date,
        min_cover=min_cover,
        derived=output.parent / f"{output.stem}_bridges",
        roads=roads,
        allow=allow or (),
    )
    _write_catalog(result, output)


@catalogs.command("gerod")
def catalog_gerod(
    root: Annotated[Path, typer.Argument(help="Folder of the paper's GeRoD dataset.")],
    output: Output,
    layout: Annotated[
        str, typer.Option(help="Configuration whose `dataset` gives the file names.")
    ] = "gerod",
    date: Date = None,
) -> None:
    """List the tiles of the GeRoD dataset."""
    from flexroad.catalog.sources import gerod
    from flexroad.pipeline.config.loading import load_config

    _write_catalog(gerod.index(root, load_config(layout).dataset, date=date), output, layout)


@catalogs.command("dsc3d")
def catalog_dsc3d(
    root: Annotated[Path, typer.Argument(help="Folder of rasters of DSC3D's scenes.")],
    output: Output,
    layout: Annotated[
        str, typer.Option(help="Configuration whose `dataset` gives the file names.")
    ] = "dsc3d",
    date: Date = None,
) -> None:
    """List the scenes of the DSC3D dataset, one tile each."""
    from flexroad.catalog.sources import dsc3d
    from flexroad.pipeline.config.loading import load_config

    _write_catalog(dsc3d.index(root, load_config(layout).dataset, date=date), output, layout)


def _write_catalog(result: TilingResult, output: Path, config: str | None = None) -> None:
    from flexroad.catalog import Catalog

    for note in result.notes:
        echo(f"note: {note}", err=True)
    catalog = Catalog(result.tiles)
    catalog.write(output)
    echo(f"{len(catalog.tiles)} tiles in {output}")
    echo(after_catalog(output, config))


@catalogs.command("synthetic")
def catalog_synthetic(
    output: Annotated[Path, typer.Option("-o", "--output", help="Folder to write.")],
    preset: Annotated[
        str | None,
        typer.Option(
            help="gerod: separate tiles as in the paper; dsc3d: five meshes; default: adjacent tiles."
        ),
    ] = None,
    tiles: Annotated[
        int | None, typer.Option(min=1, help="Number of tiles; default: 4, or all of the preset.")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the scenes.")] = 0,
    tile_size: Annotated[int | None, typer.Option(min=10, help="Size of a tile in m; default: 250.")] = None,
    dop: Annotated[bool, typer.Option("--dop", help="Also make orthophotos with pixels of 0.5 m.")] = False,
) -> None:
    """Make synthetic scenes: survey rasters, reference rasters and a catalog."""
    from flexroad.catalog import Catalog
    from flexroad.pipeline.benchmark.scenes import write_scenes

    path = write_scenes(output, tiles, seed, tile_size, dop, preset)
    echo(f"{len(Catalog.read(path).tiles)} tiles in {path}")
    echo(after_catalog(path, {"gerod": "paper"}.get(preset or "", preset)))


@catalogs.command("show")
def catalog_show(path: Annotated[Path, typer.Argument(metavar="CATALOG")]) -> None:
    """List the tiles of a catalog."""
    from flexroad.catalog import Catalog

    catalog = Catalog.read(path)
    for tile in catalog.tiles:
        if tile.fault:
            echo(f"{tile.id}  {tile.fault}")
            continue
        layers = " ".join(f"{layer.name}({len(layer.files)})" for layer in tile.layers)
        date = f"{tile.datetime:%Y-%m-%d}{' (assumed)' if tile.datetime_assumed else ''}"
        size = f"{tile.grid.width}x{tile.grid.height} at {tile.grid.cell:g} m"
        echo(f"{tile.id}  {size}  {date}  {tile.stratum or '-'}  {layers}")
    systems = sorted({tile.grid.crs for tile in catalog.usable})
    echo(f"{len(catalog.tiles)} tiles, {', '.join(crs[:60] for crs in systems)}")


@catalogs.command("check")
def catalog_check(
    path: Annotated[Path, typer.Argument(metavar="CATALOG")],
    config: Annotated[
        str | None, typer.Option(help="Configuration of the run; default: the one that fits the layers.")
    ] = None,
    allow: Allow = None,
) -> None:
    """Check a catalog: layers, what would fail in a run, and the shift between photo and heights."""
    from flexroad.catalog import Catalog
    from flexroad.pipeline.config.loading import load_config
    from flexroad.pipeline.graph.layers import fitting_config
    from flexroad.pipeline.inspect.catalog import check

    catalog, faults = Catalog.read(path, allow or ()), 0
    for remark in check(catalog, load_config(config or fitting_config(catalog))):
        echo(f"warning: {remark.text}" if remark.fault else remark.text)
        faults += remark.fault
    if faults:
        raise typer.Exit(1)
