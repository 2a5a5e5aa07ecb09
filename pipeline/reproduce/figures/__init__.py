"""The paper's figures, drawn from a run, as PDF, PNG and WebP files with a page of captions."""

from __future__ import annotations

from pathlib import Path

from matplotlib import rc_context

from flexroad.catalog.storage.paths import write
from flexroad.pipeline.reproduce.figures import dataset, maps, profile, renders, trade_off
from flexroad.pipeline.reproduce.figures.layout import STYLE, FigureFile, save
from flexroad.pipeline.reproduce.figures.roles import Roles, roles_of
from flexroad.pipeline.reproduce.figures.tile_view import TileView, read_tile_view, typical_tile
from flexroad.pipeline.reproduce.metrics_data import collect
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.store.tables import read_metrics


def write_figures(
    run: Run, folder: Path, tile_id: str | None = None, roles: Roles | None = None
) -> list[str]:
    """Draw every figure whose variants are in the run, and write ``figures.md`` with the captions.

    Parameters
    ----------
    run : Run
        A run with finished tiles.
    folder : Path
        Folder for NAME.pdf, NAME.png, NAME.webp and figures.md.
    tile_id : str, optional
        The tile of the maps, renders and profile; by default the tile with the median road L2.
    roles : Roles, optional
        Which variant is which method; by default derived from the variants' options.

    Returns
    -------
    list of str
        One line per figure that could not be drawn, with the reason.

    Raises
    ------
    ConfigError
        If no tile of the run has every variant, the run mixes datasets, or the tile's results cannot be
        recomputed.
    CatalogError
        If the catalog has no such tile.
    """
    roles = roles or roles_of(run.config)
    data = collect(run)
    rows = read_metrics(run.path)
    # As in the tables: only tiles with every variant.
    done = rows[rows.tile_id.isin(data.tiles.index[data.tiles.complete])]
    with rc_context(STYLE):
        files = _figure_files(
            run, roles, read_tile_view(run, tile_id or typical_tile(done, roles.full), roles), done
        )
        missing = [f"no figure {file.name}: {file.missing}" for file in files if file.figure is None]
        for file in files:
            if file.figure is not None:
                save(file.figure, folder, file.name)
    write(folder / "figures.md", _page(data.line, files).encode())
    return missing


def _figure_files(run: Run, roles: Roles, view: TileView, done: dataset.Table) -> list[FigureFile]:
    return [
        profile.make_figure(view, roles),
        maps.make_figure(view, roles),
        renders.make_figure(view, roles),
        trade_off.make_figure(run.config, roles.full, done),
        dataset.make_figure(dataset.statistics(run, roles.full, done)),
    ]


def _page(data: str, files: list[FigureFile]) -> str:
    parts = [data, "# Figures"]
    for file in files:
        image = f"![{file.name}]({file.name}.png)\n\n{file.caption}"
        parts.append(image if file.figure is not None else f"No figure `{file.name}`: {file.missing}")
    return "\n\n".join(parts) + "\n"
