"""``flexroad catalog``: make, show and check catalogs."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from datetime import datetime
from pathlib import Path
from typing import Annotated, Any, Literal

import typer
from rich.console import Console

from flexroad.catalog import Catalog, CatalogError, layouts
from flexroad.catalog.index import needed
from flexroad.catalog.sources import nrw, rasters, templates
from flexroad.catalog.storage.unpack import unpack
from flexroad.catalog.text import count
from flexroad.catalog.tile import MIN_COVER
from flexroad.catalog.tiling import Conversion, TilingResult
from flexroad.catalog.trust import AllowedFolders
from flexroad.pipeline.cli import options
from flexroad.pipeline.cli.command import Command, LazyGroup, group
from flexroad.pipeline.cli.stdio import echo
from flexroad.pipeline.config.loading import load_config
from flexroad.pipeline.config.options import INPUTS, MIN_COVER_HELP, OUTPUTS, TILES
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.graph.layers import fitting_config
from flexroad.pipeline.run.progress import step_progress
from flexroad.pipeline.run.record import check_inputs

TOOLS = {
    "synthetic": ("tools.synthetic.command", "Make synthetic scenes with known truth, and their catalog."),
    "check": ("tools.check.command", "Check a catalog before a long run."),
}
"""The module of each command that a tool has, as in `main.COMMANDS`."""


class _Catalogs(LazyGroup):
    """The commands of this module and of tools."""

    modules = TOOLS


app = group("catalog", "Make, show and check catalogs of tiles.", _Catalogs)

Output = Annotated[
    Path,
    options.under(
        OUTPUTS, "Catalog to write: .parquet, .json or .geojson.", "-o", "--output", metavar="FILE"
    ),
]


def _files(meaning: str, metavar: str = "PATTERN") -> Any:
    """Return an option that names input files."""
    return options.under(INPUTS, meaning, metavar=metavar)


RoadMask = Annotated[str | None, _files("Files of the road mask or land cover.")]
RoadValue = Annotated[
    list[int] | None, _files("Values of the mask that mean road; default: all except 0.", "N")
]
Roads = Annotated[
    str | None,
    _files(
        "Vector files of roads: a file, or a pattern relative to ROOT; FILE|layername=NAME for one layer."
    ),
]
Crs = Annotated[str | None, _files("CRS of files without one: EPSG:25832.", "CRS")]
Reproject = Annotated[
    bool, options.under(INPUTS, "Warp rasters in another CRS or in feet when they are read.", "--reproject")
]
Date = Annotated[
    datetime | None,
    options.under(INPUTS, "Date of the survey; default: the date of the files.", metavar="YYYY-MM-DD"),
]
TileSize = Annotated[float, options.under(TILES, "Size of a tile in m.", metavar="METRES")]
MinCover = Annotated[float, options.under(TILES, MIN_COVER_HELP, min=0, max=1, metavar="SHARE")]
Strict = Annotated[
    bool,
    options.under(
        OUTPUTS,
        "Write no catalog if a file cannot be used; default: leave it out, with exit code 1.",
        "--strict",
    ),
]
Layout = Annotated[str, _files("Configuration whose `dataset` gives the file names.", "NAME|FILE")]


@app.command("rasters", cls=Command)
def catalog_rasters(
    root: Annotated[Path, typer.Argument(metavar="ROOT", help="Folder of rasters.")],
    dsm: Annotated[str, _files("Surface model: 'dsm/*.tif' in ROOT, or '/data/dsm/*.tif'.")],
    dtm: Annotated[str, _files("Terrain model.")],
    output: Output,
    road_height: Annotated[str | None, _files("Unbiased heights of hard surfaces, for roads.")] = None,
    dop: Annotated[str | None, _files("Orthophoto.")] = None,
    road_mask: RoadMask = None,
    road_value: RoadValue = None,
    roads: Roads = None,
    reference: Annotated[str | None, _files("Reference heights, for the evaluation.")] = None,
    reference_road: Annotated[str | None, _files("Reference road mask, for the evaluation.")] = None,
    crs: Crs = None,
    reproject: Reproject = False,
    to_crs: Annotated[
        str | None,
        options.under(TILES, "CRS of the tiles, with --reproject; default: the DSM's.", metavar="CRS"),
    ] = None,
    height_unit: Annotated[
        Literal["metre", "foot", "us-foot"] | None,
        options.under(INPUTS, "Unit of heights if a file has none; default: metre, or the unit of x and y."),
    ] = None,
    date: Date = None,
    tile_size: TileSize = 250,
    min_cover: MinCover = MIN_COVER,
    strict: Strict = False,
) -> None:
    """Cut folders of GeoTIFF, ASC or XYZ into tiles."""
    patterns = {
        "dsm": dsm,
        "dtm": dtm,
        "road_height": road_height,
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
        conversion=Conversion(reproject, to_crs, height_unit),
    )
    _write_catalog(result, output, strict)


@app.command("nrw", cls=Command)
def catalog_nrw(
    root: Annotated[
        Path,
        typer.Argument(metavar="ROOT", help="Folder of Geobasis NRW downloads with their original names."),
    ],
    output: Output,
    road_mask: RoadMask = None,
    road_value: RoadValue = None,
    roads: Roads = None,
    tile_size: TileSize = 250,
    min_cover: MinCover = MIN_COVER,
    date: Date = None,
    reproject: Reproject = False,
    strict: Strict = False,
) -> None:
    """Cut downloads of Geobasis NRW into tiles.

    Files keep their original names, such as dom1_32_356_5699_1_nw_2020.tif, dgm1, dop, 3dm.
    """
    result = nrw.index(
        root,
        road_mask=road_mask,
        road_values=tuple(road_value or ()),
        tile_size_m=tile_size,
        date=date,
        min_cover=min_cover,
        derived=output.parent / f"{output.stem}_bridges",
        roads=roads,
        reproject=reproject,
    )
    _write_catalog(result, output, strict)


@app.command("gerod", cls=Command)
def catalog_gerod(
    root: Annotated[
        Path,
        typer.Argument(metavar="FOLDER|ZIP", help="The paper's GeRoD dataset, unpacked or as published."),
    ],
    output: Output,
    layout: Layout = "gerod",
) -> None:
    """List the tiles of the GeRoD dataset.

    Its files are found by the words in their paths. A zip file is unpacked into its own folder.
    """
    dataset = load_config(layout).dataset
    if root.suffix.lower() == ".zip" and not root.is_dir():
        root = unpack(root, layouts.SHA256, step_progress(Console(stderr=True)), _note)
    if templates.by_name(dataset) and root.is_dir():
        found, _ = layouts.find(root)
        for line in layouts.table(found) if found else ():
            echo(line)
        for question in layouts.questions(found):
            echo(f"question: {question}")
    derived = output.parent / f"{output.stem}_points"
    result = templates.index(root, dataset, templates.GEROD, derived=derived)
    _write_catalog(result, output, config=layout)


def _note(line: str) -> None:
    echo(f"note: {line}", err=True)


@app.command("dsc3d", cls=Command)
def catalog_dsc3d(
    root: Annotated[Path, typer.Argument(metavar="ROOT", help="Folder of rasters of DSC3D's scenes.")],
    output: Output,
    layout: Layout = "dsc3d",
) -> None:
    """List the scenes of the DSC3D dataset, one tile each."""
    result = templates.index(root, load_config(layout).dataset, templates.DSC3D)
    _write_catalog(result, output, config=layout)


def _write_catalog(
    result: TilingResult, output: Path, strict: bool = False, config: str | None = None
) -> None:
    for note in result.notes:
        echo(f"note: {note}", err=True)
    for line in result.left_out:
        echo(f"warning: {line}", err=True)
    if strict and result.left_out:
        raise CatalogError(f"{output} is not written, as files cannot be used and --strict is given")
    result.catalog.write(output)
    echo(f"{count(len(result.tiles), 'tile')} in {output}")
    if result.left_out:
        echo("warning: the catalog lacks what was skipped; repair it, then repeat the command", err=True)
    echo(after_catalog(output, config))
    if result.left_out:
        raise typer.Exit(1)


@app.command("show", cls=Command)
def catalog_show(path: options.CatalogFile) -> None:
    """List the tiles of a catalog."""
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
    echo(f"{count(len(catalog.tiles), 'tile')}, {', '.join(crs[:60] for crs in systems)}")


def after_catalog(path: Path, config: str | None = None, changes: Sequence[str] = ()) -> str:
    """Return the command that runs a catalog, ready to be pasted, or why it cannot be run.

    - `path`: the catalog's file.
    - `config`: the configuration; default: the production configuration that fits the catalog's layers.
    - `changes`: values of ``--set``.
    """
    catalog = Catalog.read(path)
    name = config or fitting_config(catalog)
    settings = load_config(name, changes)
    try:
        check_inputs(settings, catalog)
    except ConfigError as error:
        return f"before a run: {error}"
    # Many catalogs are called catalog.parquet: their folder tells them apart.
    title = path.stem if path.stem != "catalog" else path.absolute().parent.name or "run"
    # The folders of all layers are allowed, so that they also suit `catalog check` and `train`.
    allow = [
        word for folder in needed(catalog, AllowedFolders.of(path.parent)) for word in ("--allow", folder)
    ]
    words = [*allow, "run", "--config", name, *(word for change in changes for word in ("--set", change))]
    return f"next: {shlex.join(['flexroad', *words, '--catalog', str(path), '--out', f'runs/{title}'])}"
