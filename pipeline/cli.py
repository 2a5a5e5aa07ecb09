"""``flexroad ...``: the command line. Exit code 0: all done, 1: some tiles failed, 2: nothing could start."""

from __future__ import annotations

import itertools
import os
import sys
from collections.abc import Sequence
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from flexroad.catalog.errors import CatalogError
from flexroad.pipeline.cli_clean import clean
from flexroad.pipeline.cli_prepare import prepare
from flexroad.pipeline.cli_run import next_run, rerun, run, status
from flexroad.pipeline.cli_train import train
from flexroad.pipeline.ending import unread
from flexroad.pipeline.errors import ConfigError

if TYPE_CHECKING:
    from flexroad.catalog.tiling import Indexed

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
    help="Turn aerial geodata into smooth, light, georeferenced 3D road surfaces, for many tiles at once.",
)
catalogs = typer.Typer(no_args_is_help=True, help="Make and show catalogs: which tiles there are.")
configs = typer.Typer(no_args_is_help=True, help="Show configurations.")
app.add_typer(catalogs, name="catalog")
app.add_typer(prepare, name="prepare")
app.add_typer(configs, name="config")
app.command("train")(train)
for command in (run, rerun, status, clean):
    app.command()(command)

SEVERAL = ("--tile", "--road-value", "--ground-class", "--bridge-class")
"""Options that take several values in a row."""
FOLDER_FIRST = ("rerun", "clean", "figures", "rasters", "nrw")
"""Commands with a folder of their own, which must come first for that."""


def main() -> None:
    """Run the command line; what the user did wrong becomes one line and exit code 2."""
    try:
        app(spread(sys.argv[1:]), standalone_mode=True)
    except (CatalogError, ConfigError) as error:
        for line in str(error).splitlines():
            print(f"error: {line}", file=sys.stderr)  # noqa: T201
        sys.exit(2)
    except SystemExit as ended:
        if ended.code == 2:
            # Everything else that ends with 2 has told the alarm itself.
            unread(sys.argv[1:], lambda line: print(f"warning: {line}", file=sys.stderr))  # noqa: T201
        raise
    except BrokenPipeError:
        # `flexroad ... | head` closed the pipe: no fault of the run.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(0)
    except OSError as error:
        print(f"error: {error}; check the path and the disk, then repeat the command", file=sys.stderr)  # noqa: T201
        sys.exit(2)


def spread(words: Sequence[str]) -> list[str]:
    """Repeat the name of an option before each of its values: ``--tile a b`` -> ``--tile a --tile b``."""
    for command, following in itertools.pairwise(words):
        if command in FOLDER_FIRST and following.startswith("-"):
            # Of `rerun --tile a b`, b is the run.
            return list(words)
    out: list[str] = []
    name = ""
    for word in words:
        if word.startswith("-") and not word.lstrip("-").isdigit():
            name = word if word in SEVERAL else ""
        elif name and out[-1] != name:
            out.append(name)
        out.append(word)
    return out


def _say(text: str) -> None:
    typer.echo(text)


@app.callback(invoke_without_command=True)
def _root(
    version: Annotated[bool, typer.Option("--version", help="Show the version and stop.")] = False,
) -> None:
    if version:
        import importlib.metadata

        _say(importlib.metadata.version("flexroad"))
        raise typer.Exit


# --- catalog ------------------------------------------------------------------------------------------

Output = Annotated[Path, typer.Option("-o", "--output", help="Catalog to write: .parquet or .json.")]
RoadValue = Annotated[
    list[int] | None, typer.Option(help="Values of the mask that mean road; default: all but 0.")
]
Roads = Annotated[
    str | None, typer.Option(help="Vector files of roads: a file, or a pattern relative to ROOT.")
]
TileSize = Annotated[float, typer.Option(help="Size of a tile in m.")]
MinCover = Annotated[float, typer.Option(min=0, max=1, help="Leave out tiles covered less.")]
Date = Annotated[datetime | None, typer.Option(help="When the data was taken.")]


@catalogs.command("rasters")
def catalog_rasters(
    root: Annotated[Path, typer.Argument(help="Folder of rasters.")],
    dsm: Annotated[str, typer.Option(help="Files of the surface model, relative to ROOT ('dsm/*.tif').")],
    dtm: Annotated[str, typer.Option(help="Files of the terrain model.")],
    output: Output,
    dop: Annotated[str | None, typer.Option(help="Files of the orthophoto.")] = None,
    road_mask: Annotated[str | None, typer.Option(help="Files of the road mask or land cover.")] = None,
    road_value: RoadValue = None,
    roads: Roads = None,
    reference: Annotated[str | None, typer.Option(help="Files of true heights, for the evaluation.")] = None,
    reference_road: Annotated[str | None, typer.Option(help="Files of the true road mask.")] = None,
    tile_size: TileSize = 250,
    min_cover: MinCover = 0.25,
    date: Date = None,
    crs: Annotated[str | None, typer.Option(help="CRS of files that carry none: EPSG:25832.")] = None,
) -> None:
    """Cut folders of GeoTIFF, ASC, XYZ or VRT into tiles."""
    from flexroad.catalog.sources import rasters

    asked = {
        "dsm": dsm,
        "dtm": dtm,
        "dop": dop,
        "road_mask": road_mask,
        "reference": reference,
        "reference_road": reference_road,
        "roads": roads,
    }
    found = rasters.index(
        root,
        {name: pattern for name, pattern in asked.items() if pattern is not None},
        road_values=tuple(road_value or ()),
        tile_size_m=tile_size,
        date=date,
        crs=crs,
        min_cover=min_cover,
    )
    _write_catalog(found, output)


@catalogs.command("nrw")
def catalog_nrw(
    root: Annotated[Path, typer.Argument(help="Folder of Geobasis NRW downloads, under their own names.")],
    output: Output,
    road_mask: Annotated[str | None, typer.Option(help="Files of the road mask or land cover.")] = None,
    road_value: RoadValue = None,
    roads: Roads = None,
    tile_size: TileSize = 250,
    min_cover: MinCover = 0.25,
    date: Date = None,
) -> None:
    """Cut downloads of Geobasis NRW (dom1_32_356_5699_1_nw_2020.tif, dgm1, dop, 3dm) into tiles."""
    from flexroad.catalog.sources import nrw

    found = nrw.index(
        root,
        road_mask=road_mask,
        road_values=tuple(road_value or ()),
        tile_size_m=tile_size,
        date=date,
        min_cover=min_cover,
        derived=output.parent / f"{output.stem}_bridges",
        roads=roads,
    )
    _write_catalog(found, output)


@catalogs.command("gerod")
def catalog_gerod(
    root: Annotated[Path, typer.Argument(help="Folder of the paper's GeRoD dataset.")],
    output: Output,
    layout: Annotated[
        str, typer.Option(help="Configuration whose `dataset` tells the files' names.")
    ] = "gerod",
    date: Date = None,
) -> None:
    """List the tiles of the GeRoD dataset."""
    from flexroad.catalog.sources import gerod
    from flexroad.pipeline.config import load_config

    _write_catalog(gerod.index(root, load_config(layout).dataset, date=date), output)


@catalogs.command("dsc3d")
def catalog_dsc3d(
    root: Annotated[Path, typer.Argument(help="Folder of rasters of DSC3D's scenes.")],
    output: Output,
    layout: Annotated[
        str, typer.Option(help="Configuration whose `dataset` tells the files' names.")
    ] = "dsc3d",
    date: Date = None,
) -> None:
    """List the scenes of the DSC3D dataset, one tile each."""
    from flexroad.catalog.sources import dsc3d
    from flexroad.pipeline.config import load_config

    _write_catalog(dsc3d.index(root, load_config(layout).dataset, date=date), output)


def _write_catalog(found: Indexed, output: Path) -> None:
    from flexroad.catalog import Catalog

    for note in found.notes:
        typer.echo(f"note: {note}", err=True)
    catalog = Catalog(found.tiles)
    catalog.write(output)
    _say(f"{len(catalog.tiles)} tiles in {output}")
    _say(f"next: {next_run(output)}")


@catalogs.command("synthetic")
def catalog_synthetic(
    output: Annotated[Path, typer.Option("-o", "--output", help="Folder to write.")],
    preset: Annotated[
        str | None,
        typer.Option(
            help="gerod: independent tiles like the paper's 240; dsc3d: five meshes; default: neighbours."
        ),
    ] = None,
    tiles: Annotated[
        int | None, typer.Option(min=1, help="Number of tiles; default: 4, or all of the preset.")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="The same seed makes the same scenes.")] = 0,
    tile_size: Annotated[int | None, typer.Option(min=10, help="Size of a tile in m; default: 250.")] = None,
    dop: Annotated[bool, typer.Option("--dop", help="Orthophotos of 0.5 m, too.")] = False,
) -> None:
    """Make scenes with known truth: rasters, truth and a catalog."""
    from flexroad.catalog import Catalog
    from flexroad.pipeline.synthesis import write_scenes

    path = write_scenes(output, tiles, seed, tile_size, dop, preset)
    _say(f"{len(Catalog.read(path).tiles)} tiles in {path}")
    _say(f"next: {next_run(path)}")


@catalogs.command("show")
def catalog_show(path: Annotated[Path, typer.Argument(metavar="CATALOG")]) -> None:
    """List the tiles of a catalog."""
    from flexroad.catalog import Catalog

    catalog = Catalog.read(path)
    for tile in catalog.tiles:
        layers = " ".join(f"{layer.name}({len(layer.files)})" for layer in tile.layers)
        when = f"{tile.datetime:%Y-%m-%d}{' (assumed)' if tile.datetime_assumed else ''}"
        size = f"{tile.grid.width}x{tile.grid.height} at {tile.grid.cell:g} m"
        _say(f"{tile.id}  {size}  {when}  {tile.stratum or '-'}  {layers}")
    systems = sorted({tile.grid.crs for tile in catalog.tiles})
    _say(f"{len(catalog.tiles)} tiles, {', '.join(crs[:60] for crs in systems)}")


@catalogs.command("check")
def catalog_check(path: Annotated[Path, typer.Argument(metavar="CATALOG")]) -> None:
    """Look a catalog over: layers, missing files, and how far the photo lies off the heights."""
    from flexroad.catalog import Catalog
    from flexroad.pipeline.check import check

    faults = 0
    for remark in check(Catalog.read(path)):
        _say(f"warning: {remark.text}" if remark.fault else remark.text)
        faults += remark.fault
    if faults:
        raise typer.Exit(1)


# --- results ------------------------------------------------------------------------------------------


@app.command()
def report(
    path: Annotated[Path, typer.Argument(metavar="RUN")],
    form: Annotated[str, typer.Option("--format", help="md, csv or html.")] = "md",
) -> None:
    """Write RUN/report.<format>: the paper's main table over the run, worst tiles, steps, failures."""
    from flexroad.catalog.storage.paths import read
    from flexroad.pipeline.report import FORMATS, write_report
    from flexroad.pipeline.run import Run

    if form not in FORMATS:
        raise ConfigError(f"--format {form}: there are {', '.join(FORMATS)}")
    written = write_report(Run.open(path), form)
    if form != "html":
        _say(read(written).decode())
    typer.echo(f"written to {written}", err=True)


@app.command()
def tables(
    path: Annotated[Path, typer.Argument(metavar="RUN")],
    output: Annotated[Path, typer.Option("-o", "--output", help="Folder to write.")],
    true: Annotated[
        Path | None, typer.Option(metavar="RUN", help="The same run classed by the true mask.")
    ] = None,
    dsc3d: Annotated[
        Path | None,
        typer.Option(metavar="RUN", help="A run for the rows of DSC3D: its scenes, or the stand-in's."),
    ] = None,
    dsc3d_true: Annotated[
        Path | None,
        typer.Option("--dsc3d-true", metavar="RUN", help="The same scenes with the true reference."),
    ] = None,
) -> None:
    """Write the paper's tables and claims with a run's figures beside them: Markdown, LaTeX, CSV, HTML."""
    from flexroad.pipeline.report.tables import write_comparison
    from flexroad.pipeline.run import Run

    others = [Run.open(other) if other else None for other in (true, dsc3d, dsc3d_true)]
    for written in write_comparison(Run.open(path), others[0], output, *others[1:]):
        _say(str(written))


@app.command()
def figures(
    path: Annotated[Path, typer.Argument(metavar="RUN")],
    output: Annotated[Path, typer.Option("-o", "--output", metavar="DIR", help="Folder to write.")],
    tile: Annotated[
        str | None, typer.Option(help="Tile of the maps; default: the one of median road L2.")
    ] = None,
) -> None:
    """Draw the paper's figures from a run, as PDF and PNG with a page of captions."""
    from flexroad.pipeline.report.figures import write_figures
    from flexroad.pipeline.run import Run

    for note in write_figures(Run.open(path), output, tile):
        typer.echo(f"note: {note}", err=True)
    _say(f"figures in {output / 'figures.md'}")


@app.command()
def query(
    path: Annotated[Path, typer.Argument(metavar="RUN")],
    points: Annotated[Path, typer.Option(help="CSV with columns easting and northing (m).")],
    variant: Annotated[str | None, typer.Option(help="Which surface; default: the exported one.")] = None,
) -> None:
    """Tell height, unit normal, tile and class of the ground under points, as CSV."""
    from flexroad.pipeline.query import query_csv

    missed = query_csv(path, points, variant, sys.stdout)
    if missed:
        typer.echo(f"note: {missed} points lie on no finished tile; their columns are empty", err=True)


# --- config -------------------------------------------------------------------------------------------


@configs.command("show")
def config_show(
    name: Annotated[
        str | None, typer.Argument(help="A YAML file or a shipped name; default: list them.")
    ] = None,
) -> None:
    """Show a configuration as it is resolved, every option of every variant."""
    import yaml

    from flexroad.pipeline.config import load_config, shipped

    if name is None:
        for known, path in shipped().items():
            _say(f"{known:10} {path.read_text().splitlines()[0].lstrip('# ')}")
        return
    found = load_config(name)
    chains = {
        variant: {stage: options.model_dump(mode="json") for stage, options in chain.items()}
        for variant, chain in found.chains.items()
    }
    sections = {name: getattr(found, name).model_dump(mode="json") for name in ("export", "cluster")}
    _say(yaml.safe_dump({**sections, "variants": chains}, sort_keys=False))


@configs.command("template")
def config_template() -> None:
    """Print a configuration with every option, its default and its meaning."""
    from flexroad.pipeline.config import template

    typer.echo(template(), nl=False)


@configs.command("schema")
def config_schema() -> None:
    """Print the JSON schema of a configuration, for editors."""
    import json

    from flexroad.pipeline.config import schema

    _say(json.dumps(schema(), indent=1))
