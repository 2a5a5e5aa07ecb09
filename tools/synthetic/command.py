"""``flexroad catalog synthetic``: scenes with known truth."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from flexroad.catalog import Catalog
from flexroad.catalog.text import count
from flexroad.pipeline.cli.catalogs import after_catalog
from flexroad.pipeline.cli.command import Command, group
from flexroad.pipeline.cli.stdio import echo
from flexroad.tools.synthetic.scenes import write_scenes

app = group()


@app.command("synthetic", cls=Command)
def catalog_synthetic(
    output: Annotated[Path, typer.Option("-o", "--output", metavar="FOLDER", help="Folder to write.")],
    preset: Annotated[
        Literal["gerod", "dsc3d"] | None,
        typer.Option(
            help="gerod: separate tiles as in the paper; dsc3d: five meshes; default: adjacent tiles."
        ),
    ] = None,
    tiles: Annotated[
        int | None,
        typer.Option(min=1, metavar="N", help="Number of tiles; default: 4, or all of the preset."),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, metavar="N", help="Seed of the scenes.")] = 0,
    tile_size: Annotated[
        int | None, typer.Option(min=10, metavar="METRES", help="Size of a tile in m; default: 250.")
    ] = None,
    dop: Annotated[bool, typer.Option("--dop", help="Also make orthophotos with pixels of 0.5 m.")] = False,
    decks: Annotated[
        bool,
        typer.Option("--decks", help="Make roads on decks and in tunnels, with the heights of both levels."),
    ] = False,
) -> None:
    """Make synthetic scenes with known truth, and their catalog."""
    path = write_scenes(output, tiles, seed, tile_size, dop, preset, decks)
    echo(f"{count(len(Catalog.read(path).tiles), 'tile')} in {path}")
    if decks:
        echo(after_catalog(path, "production_vector", ["segment.levels=true"]))
    else:
        echo(after_catalog(path, {"gerod": "paper"}.get(preset or "", preset)))
