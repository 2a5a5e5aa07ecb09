"""The commands ``flexroad init`` and ``flexroad catalog check``."""

from __future__ import annotations

import shlex
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from flexroad.catalog import Catalog
from flexroad.pipeline.cli import options
from flexroad.pipeline.cli.command import Command, group
from flexroad.pipeline.cli.stdio import echo
from flexroad.pipeline.config.loading import load_config
from flexroad.pipeline.config.options import INPUTS
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.graph.layers import fitting_config
from flexroad.tools.check.catalog import check
from flexroad.tools.check.downloads import MAX_FILES, Download, Proposal, gerod, look, proposals

app = group()

MAX_SHOWN = 5
"""Number of files of a kind that are described."""
TITLES = {
    "dsm": "surface models (DSM)",
    "dtm": "terrain models (DTM)",
    "road_height": "heights for roads",
    "dop": "orthophotos",
    "road_mask": "road masks or land cover",
    "cloud": "point clouds",
    "roads": "vector roads",
    "vector": "other vector files",
    "mesh": "meshes",
    "photo": "photographs or images",
    "above_ground": "heights above the ground",
    "raster": "rasters of unknown content",
    "archive": "archives",
}
"""Heading of each kind of download, in the order shown."""


@app.command(cls=Command)
def init(
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="Folder of downloads.")] = Path(),
    write: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Also write a small configuration; an existing file is kept."),
    ] = None,
) -> None:
    """List the downloads in a folder, and the commands for them.

    Unclear points are printed as questions. The commands make a catalog of the files and run it.
    """
    if published := gerod(folder):
        for line in published:
            echo(line)
        return
    found, more = look(folder)
    if more:
        echo(f"note: only the first {MAX_FILES} files of {folder} were looked at; name a smaller folder")
    if not found:
        raise ConfigError(f"{folder} has no rasters, point clouds, meshes, vectors or photographs")
    _show(folder, found)
    proposed = list(proposals(folder, found))
    if write is not None:
        _write(write, folder, proposed)
    for proposal in proposed:
        echo("")
        echo(proposal.command)
        if proposal.open:
            echo(f"  {proposal.open}")
        if proposal.open or not proposal.roads:
            echo("  it prints the command of the run")
            continue
        config = str(write) if write else f"production{'_vector' * (proposal.roads == 'roads')}"
        name = proposal.catalog.stem if proposal.catalog.stem != "catalog" else proposal.catalog.parent.name
        words = ["--config", config, "--catalog", str(proposal.catalog), "--out", f"runs/{name}"]
        echo(f"flexroad catalog check {shlex.quote(str(proposal.catalog))}")
        echo(shlex.join(["flexroad", "run", *words]))


def _show(folder: Path, found: Sequence[Download]) -> None:
    """Print the downloads by kind, then the questions."""
    by_kind: dict[str, list[Download]] = defaultdict(list)
    for download in found:
        by_kind[download.kind].append(download)
    for kind, title in TITLES.items():
        downloads = by_kind[kind]
        if downloads:
            echo(f"{title}: {len(downloads)}")
        for download in downloads[:MAX_SHOWN]:
            about = f": {download.about}" if download.about else ""
            echo(f"  {download.path.relative_to(folder)}{about}")
        if len(downloads) > MAX_SHOWN:
            echo(f"  and {len(downloads) - MAX_SHOWN} more")
    asked: dict[str, list[str]] = defaultdict(list)
    for download in found:
        if download.question:
            asked[download.question].append(str(download.path.relative_to(folder)))
    for question, names in asked.items():
        more = f" and {len(names) - 1} more" if len(names) > 1 else ""
        echo(f"question: {names[0]}{more}: {question}")


def _write(path: Path, folder: Path, proposed: Sequence[Proposal]) -> None:
    """Write a configuration that extends a shipped one; an existing file is never replaced."""
    vector = any(proposal.roads == "roads" for proposal in proposed)
    text = (
        f"# For the data in {folder.resolve()}; `flexroad config template` shows all options.\n"
        f"extends: {'production_vector' if vector else 'production'}\n"
    )
    try:
        with path.open("x", encoding="utf-8") as file:
            file.write(text)
    except FileExistsError as error:
        raise ConfigError(f"--write {path} exists and is kept; name another file") from error
    except OSError as error:
        raise ConfigError(f"cannot write --write {path}: {error.strerror or error}") from error
    echo(f"wrote {path}")


@app.command("check", cls=Command)
def catalog_check(
    ctx: typer.Context,
    path: options.CatalogFile,
    config: Annotated[
        str | None,
        typer.Option(
            metavar="NAME|FILE",
            help="Configuration of the run; default: the configuration that fits the layers.",
            rich_help_panel=INPUTS,
        ),
    ] = None,
    decks: Annotated[
        bool, typer.Option("--decks", help="Search for decks on all tiles, not only on 200 tiles.")
    ] = False,
) -> None:
    """Check a catalog before a long run.

    Prints layers, expected failures of a run, the shift between photo and heights, and decks without a level.
    These are written to decks.geojson next to the catalog.
    """
    catalog, faults = Catalog.read(path, options.allowed(ctx)), 0
    for remark in check(catalog, load_config(config or fitting_config(catalog)), path, decks):
        echo(f"warning: {remark.text}" if remark.fault or remark.warning else remark.text)
        faults += remark.fault
    if faults:
        raise typer.Exit(1)
